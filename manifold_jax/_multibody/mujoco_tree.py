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
        self.joint_of: dict[int, str] = {}  # joints with a coordinate, by their index
        self.balls: dict[int, tuple[str, str]] = {}  # the bodies of ball joints, by their index

    def name(self, kind: str, i: Index) -> str:
        return name_of(self.mujoco, self.model, kind, i)

    def body(self, i: Index) -> str:
        """Return the name of the body that body `i` is part of."""
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
            for i in self._moving()
        ]

    def joints(self) -> list[AbstractJoint]:
        return [joint for i in self._moving() for joint in self._joint(i)]

    def _moving(self) -> list[int]:
        """Return the bodies that are not parts of others."""
        bodies = range(1, self.model.nbody)
        return [i for i in bodies if self.body(i) == self.name("body", i)]

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
            self.balls[own[0]] = parent, body
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
        model = self.model
        if disabled(self.mujoco, model, "EQUALITY"):
            return []
        active = np.flatnonzero(model.eq_active0)
        return [self._equality(e) for e in active if not equality_fault(self.mujoco, model, e)]

    def _equality(self, e: Index) -> AbstractJoint:
        """Convert an equality constraint of two bodies or sites, each with a point in its frame: a
        connect keeps the points together, a weld also the frames, which must coincide in the drawing."""
        model, drawing, mujoco = self.model, self.drawing, self.mujoco
        name, data = self.name("equality", e), model.eq_data[e]
        objects = bodies = model.eq_obj1id[e], model.eq_obj2id[e]
        is_weld = int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_WELD)
        local = (data[3:6], data[0:3]) if is_weld else (data[0:3], data[3:6])
        origins, frames, wanted = drawing.xpos, drawing.xmat, np.eye(3).ravel()
        if int(model.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
            bodies, local = [model.site_bodyid[i] for i in objects], np.zeros((2, 3))
            origins, frames = drawing.site_xpos, drawing.site_xmat
        elif is_weld:
            mujoco.mju_quat2Mat(wanted, data[6:10])
        first, second = (frames[i].reshape(3, 3) for i in objects)
        one = origins[objects[0]] + first @ local[0]
        other = origins[objects[1]] + second @ local[1]
        if not is_weld:
            points = self._in_body(bodies[0], one), self._in_body(bodies[1], other)
            return Spherical(*map(self.body, bodies), points=points, name=name)
        turned = first.T @ second - wanted.reshape(3, 3)
        if max(np.abs(other - one).max(), np.abs(turned).max()) > 1e-6:
            raise ValueError(
                f"The weld {name!r} holds its bodies in another pose than that of `qpos0`, which is not supported: give them "
                "in the file as they are welded."
            )
        return Fixed(*map(self.body, bodies), at=other, name=name)

    def _in_body(self, body: Index, point: np.ndarray) -> np.ndarray:
        """Return the point in our frame of the body, that of its inertia."""
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
