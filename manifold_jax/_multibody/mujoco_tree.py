"""Bodies and joints of a MuJoCo model."""

from collections.abc import Collection
from typing import Any

import numpy as np

from .bodies import Body, GROUND
from .joints import (
    AbstractJoint,
    AbstractRestraint,
    Coupling,
    Cylindrical,
    Drive,
    Fixed,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
)
from .mujoco_checks import actuator_fault, disabled, equality_fault, Index, is_of_tendon, name_of
from .mujoco_state import active_couplings, coefficients_of, link_names, quaternion_of


class Tree:
    """Bodies and joints of a model in the pose of `drawing`."""

    def __init__(self, mujoco: Any, model: Any, drawing: Any, named: Collection[str] = ()):
        self.mujoco, self.model, self.drawing = mujoco, model, drawing
        self.named = named  # joints that need a coordinate of their own
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
        return [link for i in self._moving() for link in self._links(i)]

    def joints(self) -> list[AbstractJoint]:
        return [joint for i in self._moving() for joint in self._joints(i)]

    def _moving(self) -> list[int]:
        """Return the bodies that are not parts of others."""
        bodies = range(1, self.model.nbody)
        return [i for i in bodies if self.body(i) == self.name("body", i)]

    def _links(self, i: Index) -> list[Body]:
        """Return a body, after the links without mass between its joints."""
        model, drawing = self.model, self.drawing
        place: Any = dict(
            position=drawing.xipos[i], orientation=quaternion_of(self.mujoco, drawing.ximat[i])
        )
        *between, name = link_names(self.mujoco, model, i)
        between = [] if self._joint_of_two(i) else between
        links = [Body(link, 0.0, np.zeros(3), **place) for link in between]
        return [*links, Body(name, model.body_mass[i], model.body_inertia[i], **place)]

    def _joints(self, i: Index) -> list[AbstractJoint]:
        model, drawing = self.model, self.drawing
        parent, body = self.body(model.body_parentid[i]), self.name("body", i)
        if not model.body_jntnum[i]:
            return [Fixed(parent, body, name=f"weld of {body}")]
        if joint := self._joint_of_two(i):
            return [joint]
        found: list[AbstractJoint] = []
        for j, link in zip(self._own(i), link_names(self.mujoco, model, i), strict=True):
            kind, name = self._kind(j), self.name("joint", j)
            if kind == "BALL":
                self.balls[j] = parent, link
                found.append(Spherical(parent, link, at=drawing.xanchor[j], name=name))
            elif kind != "FREE":
                self.joint_of[j] = name
                joint = Revolute if kind == "HINGE" else Prismatic
                given: Any = dict(at=drawing.xanchor[j], axis=drawing.xaxis[j], name=name)
                found.append(joint(parent, link, **given))
            parent = link
        return found

    def _joint_of_two(self, i: Index) -> AbstractJoint | None:
        """Return a joint with two coordinates for a body that has such, if nothing acts on one of them alone."""
        model, drawing, own = self.model, self.drawing, self._own(i)
        if len(own) != 2 or any(map(self._is_acted_on, own)):
            return None
        at, axes = drawing.xanchor[own], drawing.xaxis[own]
        ends = self.body(model.body_parentid[i]), self.name("body", i)
        kinds, name = [self._kind(j) for j in own], " ".join(self.name("joint", j) for j in own)
        one_point = np.allclose(*at, atol=1e-12)
        if kinds == ["HINGE", "HINGE"] and one_point and abs(axes[0] @ axes[1]) < 1e-9:
            return Universal(*ends, at=at[0], axis=(axes[0], axes[1]), name=name)
        parallel = np.linalg.norm(np.cross(*axes)) < 1e-9
        if sorted(kinds) == ["HINGE", "SLIDE"] and parallel:
            return Cylindrical(*ends, at=at[kinds.index("HINGE")], axis=axes[0], name=name)
        return None

    def _own(self, i: Index) -> list[int]:
        start = self.model.body_jntadr[i]
        return list(range(start, start + self.model.body_jntnum[i]))

    def _kind(self, j: Index) -> str:
        return self.mujoco.mjtJoint(int(self.model.jnt_type[j])).name.removeprefix("mjJNT_")

    def _is_acted_on(self, j: int) -> bool:
        """Return whether a spring, damper, rotor, actuator or coupling needs the coordinate of the joint."""
        model, first = self.model, self.model.jnt_dofadr[j]
        passive = model.jnt_stiffness[j], model.dof_damping[first], model.dof_armature[first]
        moved = [
            model.actuator_trnid[a, 0]
            for a in range(model.nactuator)
            if not (actuator_fault(self.mujoco, model, a) or is_of_tendon(self.mujoco, model, a))
        ]
        moved += list(model.wrap_objid[model.wrap_type == int(self.mujoco.mjtWrap.mjWRAP_JOINT)])
        coupled = [k for _, *pair in active_couplings(self.mujoco, model) for k in pair]
        is_named = self.name("joint", j) in self.named
        return is_named or any(value != 0 for value in passive) or j in moved or j in coupled

    def equalities(self) -> list[AbstractRestraint]:
        model = self.model
        if disabled(self.mujoco, model, "EQUALITY"):
            return []
        active = np.flatnonzero(model.eq_active0)
        return [self._equality(e) for e in active if not equality_fault(self.mujoco, model, e)]

    def _equality(self, e: Index) -> AbstractRestraint:
        """Convert an equality constraint of two joints, or of two bodies or sites, each with a point in its frame:
        a connect keeps the points together, a weld also the frames, which must coincide in the drawing."""
        model, drawing, mujoco = self.model, self.drawing, self.mujoco
        if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            return self._coupling(e)
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

    def _coupling(self, e: Index) -> AbstractRestraint:
        first, second = int(self.model.eq_obj1id[e]), int(self.model.eq_obj2id[e])
        joint, name = self.joint_of[first], self.name("equality", e)
        if second < 0:
            return Drive(joint, 0.0, name=name)
        coefficients = coefficients_of(self.model, self.drawing, e, second)
        return Coupling(joint, self.joint_of[second], coefficients, name=name)

    def _in_body(self, body: Index, point: np.ndarray) -> np.ndarray:
        """Return the point in our frame of the body, that of its inertia."""
        name = self.body(body)
        if name == GROUND:
            return point
        while self.name("body", body) != name:
            body = self.model.body_parentid[body]
        return self.drawing.ximat[body].reshape(3, 3).T @ (point - self.drawing.xipos[body])
