"""The energies of an assembly."""

from typing import Any

import jax.numpy as jnp

from .bodies import Pose
from .frames import Frames
from .known_coordinates import KnownCoordinates
from .reading import Energy
from .rotations import rates_matrix, turn


def energy_of(assembly: Any, y: tuple[Pose, Pose], known: KnownCoordinates) -> Energy:
    """Return the energies in a state in which some coordinates of joints are `known`."""
    q, v = y
    bodies, frames = assembly.bodies, Frames.of(q, v)
    moving = jnp.sum(bodies.mass[:, None] * v.position**2)
    if bodies.planar:
        turning = jnp.sum(bodies.inertia * v.orientation**2)
    else:
        spin = 2 * turn(rates_matrix(q.orientation), v.orientation)
        turning = jnp.sum(spin * turn(bodies.inertia, spin))
    of_rotors = sum((rotors.energy(frames) for rotors in assembly.rotors), jnp.zeros_like(moving))
    weight = -jnp.sum(bodies.mass * (frames.origin[:-1] @ assembly.gravity))
    stored = sum((loads.potential(frames, known) for loads in assembly.loads), weight)
    return Energy((moving + turning) / 2 + of_rotors, stored)
