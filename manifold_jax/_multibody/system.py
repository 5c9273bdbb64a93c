"""The mechanical system of an assembly, which exists already or is built from the args of the solve."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._base.user_functions import AbstractOfArgs
from .._mechanics import AbstractPositions, MechanicalSystem
from .bodies import Pose
from .checks import is_concrete
from .frames import Frames
from .joint_groups import jacobian, residuals
from .known_coordinates import KnownCoordinates, NONE_KNOWN
from .loads import add
from .rotations import rates_matrix, turn_back
from .rotors import names_of


class ConstantAssembly(eqx.Module):
    assembly: Any

    def __call__(self, args: Args) -> Any:
        return self.assembly


def only_in_joint_coordinates(assembly: Any, known: KnownCoordinates = NONE_KNOWN) -> str:
    """Return a list of what is no part of a system in the poses of bodies: its mass matrix has a nonsingular block
    for each, and angles that are read from them, not known, end at `pi`."""
    mass = assembly.bodies.mass
    massless = np.flatnonzero(np.asarray(mass) == 0) if is_concrete(mass) else ()
    found = {
        "`RotorInertia` of the joints": names_of(assembly.rotors),
        "`Coupling`": assembly.couplings.names,
        "springs, servo motors or stops beyond half a turn of the hinges": tuple(
            dict.fromkeys(
                name
                for loads in assembly.loads
                for name in loads.joints_with_whole_turns
                if name not in known.names
            )
        ),
        "bodies without mass,": tuple(assembly.bodies.names[i] for i in massless),
    }
    return "; ".join(f"{what} {list(own)[:12]}" for what, own in found.items() if own)


def check_for_poses(assembly: Any, known: KnownCoordinates = NONE_KNOWN) -> None:
    """Raise for what is no part of a system in the poses of bodies."""
    if listed := only_in_joint_coordinates(assembly, known):
        raise ValueError(
            f"The assembly has what is supported in the coordinates of joints alone: {listed}. Solve "
            "`mj.multibody.JointCoordinates(assembly)` instead of the assembly."
        )


class _InverseInertia(AbstractOfArgs):
    """Computed once in a solve, not in every evaluation."""

    function: Callable  # returns the assembly

    def __call__(self, args: Args) -> Any:
        return self.function(args).bodies.inverse_inertia()


class _Mass(eqx.Module):
    source: Callable
    inverse_inertia: Callable

    def __call__(self, q: Pose, args: Args) -> Any:
        return self.source(args).bodies.mass_matrix(q, self.inverse_inertia(args))


class JointEquations(AbstractPositions):
    """The equations of joints, and the norms of quaternions: all, or those of the given numbers."""

    source: Callable
    rows: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def __call__(
        self, t: RealScalarLike, q: Pose, args: Args
    ) -> tuple[Array, ...] | Float[Array, " m"]:
        equations = residuals(self.source(args).joints_at(t, args), q)
        if not q.planar:
            equations = (*equations, (jnp.sum(q.orientation**2, axis=1) - 1) / 2)
        if self.rows is None:
            return equations
        return jnp.concatenate([part.reshape(-1) for part in equations])[np.array(self.rows, int)]

    def jacobian(self, t: RealScalarLike, q: Pose, args: Args) -> Float[Array, "m n"]:
        rows = jacobian(self.source(args).joints_at(t, args), q)
        if not q.planar:
            p, own = q.orientation, jnp.eye(q.position.shape[0], dtype=rows.dtype)
            norms = own[:, :, None] * jnp.pad(p, ((0, 0), (3, 0)))[:, None, :]
            rows = jnp.concatenate([rows, norms])
        rows = rows.reshape(rows.shape[0], -1)
        return rows if self.rows is None else rows[np.array(self.rows, int)]


class _Forces(eqx.Module):
    """The weight, the loads, and the gyroscopic forces on quaternions."""

    source: Callable
    known: KnownCoordinates

    def __call__(self, t: RealScalarLike, q: Pose, v: Pose, args: Args) -> Pose:
        assembly, frames = self.source(args), Frames.of(q, v)
        weight = assembly.bodies.mass[:, None] * assembly.gravity[None, :]
        total = jnp.pad(weight, ((0, 1), (0, 0))), jnp.zeros_like(frames.origin)
        for loads in assembly.loads:
            total = add(total, loads.wrench(t, (q, v), frames, self.known, args))
        force, torque = total[0][:-1], total[1][:-1]
        if q.planar:
            return Pose(force[:, :2], torque[:, 2])
        local = turn_back(frames.rotation[:-1], torque)
        turning = 2 * turn_back(rates_matrix(q.orientation), local)
        return Pose(force, turning + assembly.bodies.gyroscopic(q, v))


def system_of(
    source: Callable,
    redundant: bool,
    rows: tuple[int, ...] | None = None,
    known: KnownCoordinates = NONE_KNOWN,
) -> MechanicalSystem:
    equations = JointEquations(source, rows)
    mass = _Mass(source, _InverseInertia(source))
    return MechanicalSystem(mass, equations, _Forces(source, known), redundant=redundant)


def system_in_poses(assembly: Any, known: KnownCoordinates = NONE_KNOWN) -> MechanicalSystem:
    """Return the system of an assembly in a state in which some coordinates of joints are `known`."""
    check_for_poses(assembly, known)
    rows = None if assembly.independent is None else assembly.independent.rows
    redundant = assembly.redundant and rows is None
    return system_of(ConstantAssembly(assembly), redundant, rows, known)
