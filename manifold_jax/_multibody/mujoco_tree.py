"""Bodies and joints of a MuJoCo model."""

from collections.abc import Collection
from typing import Any

import numpy as np

from .bodies import Body, GROUND
from .joints import (
    AbstractJoint,
    Cylindrical,
    Fixed,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
)
from .mujoco_checks import actuator_fault, is_of_tendon
from .mujoco_drawing import active_couplings
from .mujoco_model import in_effect, Index, name_of
from .mujoco_state import link_names, quaternion_of


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
        i = self.whole(i)
        return GROUND if i == 0 else self.name("body", i)

    def whole(self, i: Index) -> Index:
        """Return the number of the body that body `i` is part of, 0 for the ground."""
        model = self.model
        if model.body_weldid[i] == 0:
            return 0
        while i != 0 and model.body_mass[i] == 0 and model.body_jntnum[i] == 0:
            i = model.body_parentid[i]
        return i

    def bodies(self) -> list[Body]:
        return [link for i in self._moving() for link in self._links(i)]

    def joints(self) -> list[AbstractJoint]:
        return [joint for i in self._moving() for joint in self._joints(i)]

    def _moving(self) -> list[int]:
        """Return the bodies that are not parts of others."""
        return [i for i in range(1, self.model.nbody) if self.whole(i) == i]

    def _links(self, i: Index) -> list[Body]:
        """Return a body, after the links without mass between its joints."""
        model, drawing = self.model, self.drawing
        place: Any = dict(
            position=drawing.xipos[i], orientation=quaternion_of(self.mujoco, drawing.ximat[i])
        )
        *between, name = link_names(self.mujoco, model, i)
        between = [] if self._joint_of_two(i) else between
        links = [Body(link, 0.0, np.zeros(3), **place) for link in between]
        return [*links, Body(name, model.body_mass[i], self._inertia(i), **place)]

    def _inertia(self, i: Index) -> np.ndarray:
        """Return the inertia of a body, with those of its parts, which have no mass but may have an inertia."""
        own, frames = self.model.body_inertia, self.drawing.ximat.reshape(-1, 3, 3)
        found = np.diag(own[i])
        for k in range(1, self.model.nbody):
            if k != i and self.whole(k) == i:
                turned = frames[i].T @ frames[k]
                found = found + turned @ np.diag(own[k]) @ turned.T
        return found

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
        stiffness, damping = (
            in_effect(self.mujoco, model, name)[at]
            for name, at in (("jnt_stiffness", j), ("dof_damping", first))
        )
        passive = stiffness, damping, model.dof_armature[first]
        moved = [
            model.actuator_trnid[a, 0]
            for a in range(model.nactuator)
            if not (actuator_fault(self.mujoco, model, a) or is_of_tendon(self.mujoco, model, a))
        ]
        moved += list(model.wrap_objid[model.wrap_type == int(self.mujoco.mjtWrap.mjWRAP_JOINT)])
        coupled = [k for _, *pair in active_couplings(self.mujoco, model) for k in pair]
        is_named = self.name("joint", j) in self.named
        return is_named or any(value != 0 for value in passive) or j in moved or j in coupled
