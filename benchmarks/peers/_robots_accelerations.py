"""Accelerations of a robot against those of Pinocchio and MuJoCo, and the time of one evaluation."""

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..tools.measure import interleaved


def compare(
    urdf: Path, closures: dict[str, Any], robot: Any
) -> tuple[float | None, float | None, dict[str, Any]]:
    """Return the largest difference of accelerations from the independent ones, the largest of these, and a
    program for one evaluation in Pinocchio."""
    if importlib.util.find_spec("pinocchio") is None or closures.get("joint_name"):
        return None, None, {}
    from ._pinocchio import Tree

    tree, machine = Tree(urdf, closures), robot.assembly
    q = tree.coordinates(robot)
    v = tree.random_velocity(q, seed=0)
    centers = dict(zip(machine.names, np.asarray(machine.bodies.drawing.position), strict=True))
    motions = tree.of_points(q, v, tree.accelerations(q, v), centers)
    y = machine.state(
        velocities={name: motion[0] for name, motion in motions.items()},
        angular_velocities={name: motion[1] for name, motion in motions.items()},
    )
    found = eqx.filter_jit(machine.system.accelerations)(0.0, y, None).position
    expected = np.array([motions[name][2] for name in machine.names])
    largest = float(np.abs(expected).max())
    difference = float(np.abs(found - expected).max())
    return difference, largest, {"pinocchio": tree.forward_dynamics(q, v)}


def soften(
    urdf: Path, closures: dict[str, Any], robot: Any, stiffness: float, seconds: float
) -> tuple[dict[str, float], dict[str, Any], list[Any]]:
    """Return differences of accelerations at rest from MuJoCo's with loops held exactly, and of MuJoCo's own from
    these; a program for one evaluation; and the swings."""
    if importlib.util.find_spec("mujoco") is None:
        return {}, {}, []
    from ._robots_mujoco import Soft, STEPS

    soft, machine = Soft(urdf, closures, robot, stiffness), robot.assembly
    forward, own, held = soft.accelerations(robot)
    found = eqx.filter_jit(machine.system.accelerations)(0.0, machine.state(), None).position
    off = lambda a, b: float(np.abs(np.asarray(a) - b).max())
    rest = {"difference": off(found, held), "mujoco": off(own, held)}
    runs = [soft.swing(seconds, step) for step in STEPS]
    return rest, {"mujoco": forward}, [run and dataclasses.asdict(run) for run in runs]


def evaluations(machine: Any, others: dict[str, Any]) -> dict[str, float]:
    """Return milliseconds of one evaluation of all accelerations."""
    y, program = machine.state(), eqx.filter_jit(machine.system.accelerations)
    own = lambda: jax.block_until_ready(program(0.0, y, None))
    timings = interleaved({"manifold_jax": own, **others}, 50)
    return {name: timing.median_ms for name, timing in timings.items()}
