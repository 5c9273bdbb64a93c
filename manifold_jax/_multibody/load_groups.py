"""The forces of an assembly, those of one kind together."""

from typing import Any

import numpy as np

from . import forces, joints
from .attachment import attach, name_all
from .bodies import Bodies
from .checks import check_number, check_value, check_vector, is_concrete, stack
from .frames import in_space
from .joint_groups import attachment_of, find_joint, JointGroup
from .loads import AbstractLoads, BodyLoads, JointLoads, LineLoads, SpringLaws


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
        kind = find_joint(groups, force.joint, name)[0].kind
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
        found = [find_joint(groups, thing.joint, name) for thing, name in given]
        return JointLoads(
            kind == "hinge", attachment_of(found, names), _laws(things, names, "rest")
        )
    return _on_bodies(kind == "torque", bodies, things, names)


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
    values = tuple(
        check_value("value", law.value, name, ()) for law, name in zip(laws, names, strict=True)
    )
    driven = any(callable(v) or not is_concrete(v) or np.any(np.asarray(v)) for v in values)
    columns = (stack(column) for column in zip(*numbers, strict=True))
    return SpringLaws(tuple(names), *columns, values if driven else None)  # pyright: ignore[reportCallIssue]


def _on_bodies(torque: bool, bodies: Bodies, things: list[Any], names: list[str]) -> BodyLoads:
    index, points, values = [], [], []
    d = 2 if bodies.planar else 3
    shape = () if torque and bodies.planar else (d,)
    for thing, name in zip(things, names, strict=True):
        index.append(bodies.moving_index(thing.body, name))
        point = getattr(thing, "point", None)
        points.append(check_vector(f"{name}: `point`", np.zeros(d) if point is None else point, d))
        values.append(check_value("value", thing.value, name, shape))
    return BodyLoads(
        torque, bodies.planar, tuple(names), tuple(index), in_space(stack(points)), tuple(values)
    )
