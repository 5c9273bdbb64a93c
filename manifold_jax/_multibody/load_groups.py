"""The forces of an assembly, those of one kind together."""

from typing import Any

import numpy as np

from . import forces, joints
from .attachment import attach, grouped, name_all
from .bodies import Bodies
from .checks import check_shape, is_concrete, stack, Values
from .equations import DRIVEN
from .frames import in_space
from .joint_groups import JointGroup
from .loads import AbstractLoads, BodyLoads, JointLoads, LineLoads, SpringLaws
from .restraints import attachment_of, find_joint, Found


_ADVICE = "Springs and motors belong to `Revolute` and `Prismatic` joints; between points use `Spring` and `LinearActuator`."


def group_forces(
    bodies: Bodies, groups: tuple[JointGroup, ...], given: Any
) -> tuple[AbstractLoads, ...]:
    in_joint = lambda force: isinstance(force, forces.AbstractJointForce)
    named = [
        (force, name, find_joint(groups, force.joint, name, _ADVICE) if in_joint(force) else None)
        for force, name in name_all(given, forces.AbstractForce, "force")
    ]
    return tuple(_loads(kind, bodies, *own) for kind, own in grouped(named, _kind).items())


def _kind(force: Any, name: str, found: Found | None) -> type:
    """The kind of its joint if it is in one."""
    if found is not None:
        return found[0].kind
    kinds = forces.AbstractLineForce, forces.Torque
    return next((kind for kind in kinds if isinstance(force, kind)), forces.Force)


def _loads(
    kind: type, bodies: Bodies, things: tuple, names: tuple[str, ...], found: tuple
) -> AbstractLoads:
    if kind is forces.AbstractLineForce:
        return LineLoads(attach(bodies, things, names), _laws(things, names, "length"))
    if kind in DRIVEN:
        laws = _laws(things, names, "rest")
        return JointLoads(kind is joints.Revolute, attachment_of(found, names), laws)
    return _on_bodies(kind is forces.Torque, bodies, things, names)


def _laws(things: tuple, names: tuple[str, ...], rest: str) -> SpringLaws:
    """What a force does not have is zero."""
    named = list(zip(things, names, strict=True))
    stiffness, rest_at, damping = (
        stack([check_shape(f"{n}: `{word}`", getattr(thing, word, 0.0), ()) for thing, n in named])
        for word in ("stiffness", rest, "damping")
    )
    values = Values("value", names, (), [getattr(thing, "value", 0.0) for thing in things])
    driven = any(callable(v) or not is_concrete(v) or np.any(np.asarray(v)) for v in values.given)
    return SpringLaws(stiffness, rest_at, damping, values if driven else None)


def _on_bodies(torque: bool, bodies: Bodies, things: tuple, names: tuple[str, ...]) -> BodyLoads:
    d = 2 if bodies.planar else 3
    index, points = [], []
    for thing, name in zip(things, names, strict=True):
        index.append(bodies.moving_index(thing.body, name))
        point = getattr(thing, "point", None)
        point = np.zeros(d) if point is None else point
        points.append(check_shape(f"{name}: `point`", point, (d,)))
    shape = () if torque and bodies.planar else (d,)
    values = Values("value", names, shape, [thing.value for thing in things])
    return BodyLoads(torque, tuple(index), in_space(stack(points)), values)
