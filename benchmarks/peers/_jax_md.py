"""A rigid molecule by jax-md, whose orientation is a quaternion: splitting of its free rotation about the axes
(Miller et al., J. Chem. Phys. 116 (2002) 8649-8659), in its simulation of constant energy."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import rigid_body, simulate, space

from ._long_time_molecule import ATTRACTIONS, BODY, MASSES, PLACES, RATE, VELOCITY


def run_molecule(step: float, every: int, samples: int) -> Callable[[], tuple[Any, Any]]:
    """Return a compiled program, which returns positions and velocities of the atoms after every `every` steps."""
    body, masses, places = (jnp.asarray(x) for x in (BODY, MASSES, PLACES))
    inertia = np.sum(MASSES[:, None] * (np.sum(BODY**2, axis=1)[:, None] - BODY**2), axis=0)
    start = rigid_body.RigidBody(
        jnp.zeros((1, 3)), rigid_body.Quaternion(jnp.array([[1.0, 0.0, 0.0, 0.0]]))
    )
    spin = rigid_body.angular_momentum_to_conjugate_momentum(
        start.orientation, jnp.asarray((inertia * RATE)[None])
    )
    momenta = rigid_body.RigidBody(jnp.asarray(MASSES.sum() * VELOCITY[None]), spin)
    mass = rigid_body.RigidBody(jnp.asarray(MASSES.sum()[None]), jnp.asarray(inertia[None]))

    def atoms(center, orientation):
        turn = jax.vmap(rigid_body.quaternion_rotate, (None, 0))
        return center[0] + turn(rigid_body.Quaternion(orientation.vec[0]), body)

    def energy(position, **_):
        d = atoms(position.center, position.orientation) - places
        return jnp.sum(jnp.asarray(ATTRACTIONS)[:, None] * d * d) / 2

    def observed(state):
        position, momentum = state.position, state.momentum
        quaternion = rigid_body.Quaternion(position.orientation.vec[0])
        angular = rigid_body.conjugate_momentum_to_angular_momentum(
            position.orientation, momentum.orientation
        )[0]
        rates = jnp.cross(angular / jnp.asarray(inertia), body)
        turned = jax.vmap(rigid_body.quaternion_rotate, (None, 0))(quaternion, rates)
        return atoms(position.center, position.orientation), turned + momentum.center[
            0
        ] / masses.sum()

    _, shift = space.free()
    init, advance = simulate.nve(energy, shift, step)
    state = init(jax.random.PRNGKey(0), start, 0.0, mass=mass, momenta=momenta)

    def some(state, _):
        state = jax.lax.fori_loop(0, every, lambda _, state: advance(state), state)
        return state, observed(state)

    program = jax.jit(lambda state: jax.lax.scan(some, state, length=samples)[1])
    compiled = program.lower(state).compile()
    return lambda: compiled(state)
