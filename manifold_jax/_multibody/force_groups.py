"""The forces that users describe, as loads: all of one kind together."""

from typing import Any

import numpy as np

from .._base.user_functions import check_function
from . import contacts, forces, joints
from .attachment import attach, grouped, name_all
from .bodies import Bodies
from .checks import check_shape, is_concrete, stack, Values
from .contact_loads import contact_loads, friction_laws, stop_laws
from .frames import in_space
from .joint_groups import attachment_of, find_joint, Found, JointGroup
from .loads import (
    AbstractLoads,
    BodyLoads,
    ControlledLoads,
    JointLoads,
    LineLoads,
    RotationalLoads,
    SpringLaws,
)
from .tendon_loads import tendon_loads


_ADVICE = "Springs and motors belong to `Revolute` and `Prismatic` joints; between points use `Spring` and `LinearActuator`."


def group_forces(
    bodies: Bodies, groups: tuple[JointGroup, ...], given: Any
) -> tuple[AbstractLoads, ...]:
    in_joint = lambda force: isinstance(force, forces.AbstractJointForce)
    everything = [
        (force, name)
        for force, name in name_all(given, forces.AbstractForce, "force")
        if not isinstance(force, forces.RotorInertia)
    ]
    named = [
        (force, name, find_joint(groups, force.joint, name, _ADVICE) if in_joint(force) else None)
        for force, name in everything
        if not isinstance(force, forces.Controller | forces.Tendon)
    ]
    tendons = [(force, name) for force, name in everything if isinstance(force, forces.Tendon)]
    controlled = [
        _controlled(groups, force, name)
        for force, name in everything
        if isinstance(force, forces.Controller)
    ]
    kinds = grouped(named, _kind).items()
    alone = [_loads(kind, bodies, *own) for kind, own in kinds]
    return (*alone, *_through_joints(groups, tendons), *controlled)


def _through_joints(
    groups: tuple[JointGroup, ...], named: list[tuple[Any, str]]
) -> tuple[AbstractLoads, ...]:
    if not named:
        return ()
    tendons, names = zip(*named, strict=True)
    return (tendon_loads(groups, tendons, names, _laws(tendons, names, "rest")),)


def _controlled(
    groups: tuple[JointGroup, ...], controller: forces.Controller, name: str
) -> ControlledLoads:
    check_function(f"law` of `{name}", controller.law, "f(t, y, args)")
    if not controller.joints:
        raise ValueError(f"{name}: `joints` must name at least one hinge or slider.")
    advice = "Controllers belong to `Revolute` and `Prismatic` joints."
    found = tuple(find_joint(groups, joint, name, advice) for joint in controller.joints)
    hinges = tuple(group.kind is joints.Revolute for group, _ in found)
    return ControlledLoads(hinges, attachment_of(found, controller.joints), controller.law)


def _kind(force: Any, name: str, found: Found | None) -> tuple[type, type | None]:
    """Return the kind of a force, and that of the joint that it acts in."""
    kinds = (
        forces.AbstractLineForce,
        forces.Torque,
        forces.RotationalDamper,
        contacts.JointStop,
        contacts.JointFriction,
        contacts.GroundContact,
        forces.AbstractJointForce,
    )
    kind = next((kind for kind in kinds if isinstance(force, kind)), forces.Force)
    return kind, None if found is None else found[0].kind


def _loads(
    kinds: tuple[type, type | None], bodies: Bodies, things: tuple, names: tuple, found: tuple
) -> AbstractLoads:
    kind, joint = kinds
    if joint is not None:
        laws = {contacts.JointStop: stop_laws, contacts.JointFriction: friction_laws}
        hinge = joint is joints.Revolute
        own = laws.get(kind, _joint_laws)(things, names)
        of_joints = tuple(thing.joint for thing in things)
        return JointLoads(hinge, of_joints, attachment_of(found, names), own)
    if kind is forces.AbstractLineForce:
        return LineLoads(attach(bodies, things, names), _laws(things, names, "length"))
    if kind is forces.RotationalDamper:
        return _rotational(bodies, things, names)
    if kind is contacts.GroundContact:
        return contact_loads(bodies, things, names)
    return _on_bodies(kind is forces.Torque, bodies, things, names)


def _joint_laws(things: tuple, names: tuple[str, ...]) -> SpringLaws:
    return _laws(things, names, "rest")


def _rotational(bodies: Bodies, dampers: tuple, names: tuple[str, ...]) -> RotationalLoads:
    named = list(zip(dampers, names, strict=True))
    for damper, name in named:
        if damper.first == damper.second:
            raise ValueError(f"{name} connects {damper.first!r} with itself.")
    first, second = (
        tuple(bodies.index(getattr(damper, side), name) for damper, name in named)
        for side in ("first", "second")
    )
    damping = [check_shape(f"{name}: `damping`", damper.damping, ()) for damper, name in named]
    return RotationalLoads((first, second), stack(damping))


def _laws(things: tuple, names: tuple[str, ...], rest: str) -> SpringLaws:
    """Return the laws of forces; missing arguments are zero."""
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
