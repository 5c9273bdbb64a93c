"""The forces of an assembly, those of one kind together."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._user_function import check_function
from . import forces, joints
from .attachment import attach, Attachment, name_all
from .bodies import Bodies
from .checks import check_number, check_shape, check_vector, is_concrete, stack
from .frames import in_space
from .joint_groups import JointGroup
from .loads import AbstractLoads, BodyLoads, JointLoads, LineLoads, SpringLaws


Found = tuple[JointGroup, int]  # a joint: its group and its place in that


def group_forces(
    bodies: Bodies, groups: tuple[JointGroup, ...], given: Any
) -> tuple[AbstractLoads, ...]:
    kinds: dict[str, list[tuple[Any, str]]] = {}
    for force, name in zip(*name_all(given, forces.AbstractForce, "force"), strict=True):
        kinds.setdefault(_kind(force, name, groups), []).append((force, name))
    return tuple(_loads(kind, bodies, groups, own) for kind, own in kinds.items())


def _kind(force: Any, name: str, groups: tuple[JointGroup, ...]) -> str:
    if isinstance(force, forces.AbstractLineForce):
        return "line"
    if isinstance(force, forces.AbstractJointForce):
        kind = _find_joint(groups, force.joint, name)[0].kind
        if kind not in (joints.Revolute, joints.Prismatic):
            raise ValueError(
                f"{name}: the joint {force.joint!r} is a {kind.__name__}, which has no single coordinate. Springs and "
                "motors belong to `Revolute` and `Prismatic` joints; between points use `Spring` and `LinearActuator`."
            )
        return "hinge" if kind is joints.Revolute else "slider"
    return "torque" if isinstance(force, forces.Torque) else "force"


def _loads(
    kind: str, bodies: Bodies, groups: tuple[JointGroup, ...], given: list[tuple[Any, str]]
) -> AbstractLoads:
    things, names = map(list, zip(*given, strict=True))
    if kind == "line":
        return LineLoads(attach(bodies, things, names), _laws(things, names, "length"))
    if kind in ("hinge", "slider"):
        found = [_find_joint(groups, thing.joint, name) for thing, name in given]
        return JointLoads(kind == "hinge", _attached(found, names), _laws(things, names, "rest"))
    return _on_bodies(kind == "torque", bodies, things, names)


def _find_joint(groups: tuple[JointGroup, ...], joint: str, name: str) -> Found:
    for group in groups:
        if joint in group.attachment.names:
            return group, group.attachment.names.index(joint)
    known = [name for group in groups for name in group.attachment.names][:12]
    raise ValueError(f"{name} names the joint {joint!r}, which is not there. Joints are {known}.")


def _attached(found: list[Found], names: list[str]) -> Attachment:
    """To the bodies of joints, as these are."""

    def of_joints(part: str) -> Array:
        rows = [(getattr(group.attachment, part), i) for group, i in found]
        if all(is_concrete(row) for row, _ in rows):
            return jnp.asarray(np.stack([np.asarray(row)[:, i] for row, i in rows], axis=1))
        return jnp.stack([row[:, i] for row, i in rows], axis=1)

    first, second = (
        tuple(group.attachment.bodies[side][i] for group, i in found) for side in (0, 1)
    )
    return Attachment(tuple(names), (first, second), of_joints("points"), of_joints("axes"))


def _laws(things: list[Any], names: list[str], rest: str) -> SpringLaws:
    words = "stiffness", rest, "damping"
    laws = [thing.law for thing in things]
    numbers = [
        [
            check_number(f"{name}: `{word}`", number)
            for word, number in zip(words, law, strict=False)
        ]
        for law, name in zip(laws, names, strict=True)
    ]
    values = tuple(_value(law.value, name, ()) for law, name in zip(laws, names, strict=True))
    driven = any(callable(v) or not is_concrete(v) or np.any(v) for v in values)
    columns = (stack(column) for column in zip(*numbers, strict=True))
    return SpringLaws(tuple(names), *columns, values if driven else None)  # pyright: ignore[reportCallIssue]


def _value(value: Any, name: str, shape: tuple[int, ...]) -> Any:
    if callable(value):
        check_function(f"value` of `{name}", value, "f(t, args)")
        return value
    return check_shape(f"{name}: `value`", value, shape)


def _on_bodies(torque: bool, bodies: Bodies, things: list[Any], names: list[str]) -> BodyLoads:
    index, points, values = [], [], []
    d = 2 if bodies.planar else 3
    shape = () if torque and bodies.planar else (d,)
    for thing, name in zip(things, names, strict=True):
        index.append(bodies.moving_index(thing.body, name))
        point = getattr(thing, "point", None)
        points.append(check_vector(f"{name}: `point`", np.zeros(d) if point is None else point, d))
        values.append(_value(thing.value, name, shape))
    return BodyLoads(
        torque, bodies.planar, tuple(names), tuple(index), in_space(stack(points)), tuple(values)
    )
