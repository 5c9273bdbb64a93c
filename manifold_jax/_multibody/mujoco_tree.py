"""Bodies and joints of a MuJoCo model."""

from typing import Any

import numpy as np

from .bodies import Body, GROUND
from .joints import AbstractJoint, Cylindrical, Fixed, Prismatic, Revolute, Spherical, Universal
from .mujoco_checks import disabled, equality_fault, Index, name_of


class Tree:
    """Bodies and joints of a model in the pose `qpos0`."""

    def __init__(self, mujoco: Any, model: Any, drawing: Any):
        self.mujoco, self.model, self.drawing = mujoco, model, drawing
        self.joint_of: dict[int, str] = {}  # those with a coordinate, by their index

    def name(self, kind: str, i: Index) -> str:
        return name_of(self.mujoco, self.model, kind, i)

    def body(self, i: Index) -> str:
        """The name of the body that body `i` is part of."""
        model = self.model
        if model.body_weldid[i] == 0:
            return GROUND
        while model.body_mass[i] == 0 and model.body_jntnum[i] == 0:
            i = model.body_parentid[i]
        return self.name("body", i)

    def bodies(self) -> list[Body]:
        model, drawing = self.model, self.drawing
        return [
            Body(
                self.name("body", i),
                model.body_mass[i],
                model.body_inertia[i],
                position=drawing.xipos[i],
                orientation=quaternion_of(self.mujoco, drawing.ximat[i]),
            )
            for i in range(1, model.nbody)
            if self.body(i) == self.name("body", i)
        ]

    def joints(self) -> list[AbstractJoint]:
        found = []
        for i in range(1, self.model.nbody):
            if self.body(i) == self.name("body", i):
                found += self._joint(i)
        return found

    def _joint(self, i: Index) -> list[AbstractJoint]:
        model, drawing, kinds = self.model, self.drawing, self.mujoco.mjtJoint
        start = model.body_jntadr[i]
        own = list(range(start, start + model.body_jntnum[i]))
        parent, body = self.body(model.body_parentid[i]), self.name("body", i)
        if not own:
            return [Fixed(parent, body, name=f"weld of {body}")]
        types = tuple(kinds(int(model.jnt_type[j])).name.removeprefix("mjJNT_") for j in own)
        at, axes = drawing.xanchor[own[0]], [drawing.xaxis[j] for j in own]
        one_point = all(np.allclose(drawing.xanchor[j], at, atol=1e-12) for j in own)
        name = " ".join(self.name("joint", j) for j in own)
        if types == ("FREE",):
            return []
        if types == ("BALL",):
            return [Spherical(parent, body, at=at, name=name)]
        if len(own) == 1:
            self.joint_of[own[0]] = name
            kind = Revolute if types == ("HINGE",) else Prismatic
            return [kind(parent, body, at=at, axis=axes[0], name=name)]
        if types == ("HINGE", "HINGE") and one_point and abs(axes[0] @ axes[1]) < 1e-9:
            return [Universal(parent, body, at=at, axis=(axes[0], axes[1]), name=name)]
        parallel = np.linalg.norm(np.cross(axes[0], axes[1])) < 1e-9
        if sorted(types) == ["HINGE", "SLIDE"] and parallel:
            hinge = own[types.index("HINGE")]
            return [Cylindrical(parent, body, at=drawing.xanchor[hinge], axis=axes[0], name=name)]
        raise ValueError(
            f"The body {body!r} has the joints {name!r} ({', '.join(types).lower()}), which together are none of the joints "
            "supported: one hinge, slide, ball or free; two perpendicular hinges through one point; hinge and slide on "
            "one axis."
        )

    def equalities(self) -> list[AbstractJoint]:
        model, drawing = self.model, self.drawing
        if disabled(self.mujoco, model, "EQUALITY"):
            return []
        found = []
        for e in range(model.neq):
            if not model.eq_active0[e] or equality_fault(self.mujoco, model, e):
                continue
            name, data = self.name("equality", e), model.eq_data[e]
            of_sites = int(model.eq_objtype[e]) == int(self.mujoco.mjtObj.mjOBJ_SITE)
            objects = model.eq_obj1id[e], model.eq_obj2id[e]
            bodies = [model.site_bodyid[i] for i in objects] if of_sites else list(objects)
            if model.eq_type[e] == int(self.mujoco.mjtEq.mjEQ_WELD):
                found.append(self._weld(name, bodies, objects, data, of_sites))
                continue
            local = (data[0:3], data[3:6])
            where = [
                drawing.site_xpos[i] if of_sites else self._in_space(b, p)
                for i, b, p in zip(objects, bodies, local, strict=True)
            ]
            points = tuple(self._in_body(b, p) for b, p in zip(bodies, where, strict=True))
            found.append(Spherical(*map(self.body, bodies), points=points, name=name))
        return found

    def _weld(self, name: str, bodies: list, objects: tuple, data: Any, of_sites: bool) -> Fixed:
        drawing = self.drawing
        first, second = (drawing.xmat[b].reshape(3, 3) for b in bodies)
        turned, wanted = np.zeros(9), np.eye(3)
        if not of_sites:
            self.mujoco.mju_quat2Mat(turned, data[6:10])
            wanted = turned.reshape(3, 3)
            shift = self._in_space(bodies[1], data[0:3]) - self._in_space(bodies[0], data[3:6])
            at = self._in_space(bodies[1], data[0:3])
        else:
            first, second = (drawing.site_xmat[i].reshape(3, 3) for i in objects)
            shift = drawing.site_xpos[objects[1]] - drawing.site_xpos[objects[0]]
            at = drawing.site_xpos[objects[1]]
        if max(np.abs(shift).max(), np.abs(first.T @ second - wanted).max()) > 1e-6:
            raise ValueError(
                f"The weld {name!r} holds its bodies in another pose than that of `qpos0`, which is not supported: give them "
                "in the file as they are welded."
            )
        return Fixed(*map(self.body, bodies), at=at, name=name)

    def _in_space(self, body: Index, point: np.ndarray) -> np.ndarray:
        """Return the position in space of a point in MuJoCo's frame of a body."""
        return self.drawing.xpos[body] + self.drawing.xmat[body].reshape(3, 3) @ point

    def _in_body(self, body: Index, point: np.ndarray) -> np.ndarray:
        """Return the point in our frame, that of its inertia."""
        name = self.body(body)
        if name == GROUND:
            return point
        while self.name("body", body) != name:
            body = self.model.body_parentid[body]
        return self.drawing.ximat[body].reshape(3, 3).T @ (point - self.drawing.xipos[body])


def quaternion_of(mujoco: Any, matrix: np.ndarray) -> np.ndarray:
    p = np.zeros(4)
    mujoco.mju_mat2Quat(p, np.ascontiguousarray(matrix).reshape(9))
    return p
