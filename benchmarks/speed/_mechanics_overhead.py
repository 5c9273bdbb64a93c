"""The part of `benchmarks.speed.overhead` that is about mechanisms: a batch of double pendulums.

Accelerations by the unrolled Schur complement next to the textbook way, one dense solve of
`[[M, J^T], [J, 0]] [a, lambda] = [Q, -bias]`; and projection and local coordinates next to the
plain solver.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj
from manifold_jax.problems import Problem

from ..tools.measure import compiled, interleaved, Timing


BATCH = 512
TOLERANCE = 1e-6


def starts(problem: Problem, size: int) -> Any:
    """Both rods turned by the same random angles, at rest."""
    q = np.asarray(problem.y0[0]).reshape(-1, 2)
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, size)
    cos, sin = np.cos(angles), np.sin(angles)
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    turned = jnp.asarray(np.einsum("bij,kj->bki", rotation, q).reshape(size, -1))
    return turned, jnp.zeros_like(turned)


def dense_accelerations(problem: Problem, t: Any, y: Any) -> Any:
    """One `jnp.linalg.solve` of the whole system, with derivatives by `jax.jacfwd`."""
    q, v = y
    system, args = problem.system, problem.args
    phi = lambda q: system.holonomic(t, q, args)
    J = jax.jacfwd(phi)(q)
    bias = jax.jacfwd(lambda q: jax.jacfwd(phi)(q) @ v)(q) @ v
    m, n = J.shape
    M = jnp.diag(system.mass_matrix(t, q, v, args))
    K = jnp.block([[M, J.T], [J, jnp.zeros((m, m))]])
    Q = system.force(t, q, v, args)
    return jnp.linalg.solve(K, jnp.concatenate([Q, -bias]))[:n]


def time_accelerations(problem: Problem, repeats: int) -> dict[str, Timing]:
    y = starts(problem, BATCH)
    ours = lambda y: problem.system.accelerations(0.0, y, problem.args)
    dense = functools.partial(dense_accelerations, problem, 0.0)
    runs = {
        name: compiled(jax.vmap(function), y)[0]
        for name, function in (("Schur, unrolled", ours), ("KKT, jnp.linalg.solve", dense))
    }
    a, b = (np.asarray(run()) for run in runs.values())
    assert np.max(np.abs(a - b)) < 1e-9
    return interleaved(runs, repeats)


def time_solves(problem: Problem, repeats: int) -> dict[str, Timing]:
    """A batch of solves: plain Diffrax, projected, and in local coordinates."""
    y = starts(problem, BATCH)

    def solver_run(diffeqsolve: Callable, solver: Any) -> Callable:
        def run(y0: Any) -> Any:
            return diffeqsolve(
                problem.terms,
                solver,
                0.0,
                3.0,
                None,
                y0,
                problem.args,
                stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            ).ys

        return jax.vmap(run)

    constraint = problem.constraint
    functions = {
        "plain": solver_run(dfx.diffeqsolve, dfx.Tsit5()),
        "projected": solver_run(mj.diffeqsolve, mj.Projected(dfx.Tsit5(), constraint)),
        "local coordinates": solver_run(
            mj.diffeqsolve, mj.LocalCoordinates(dfx.Tsit5(), constraint)
        ),
    }
    runs = {name: compiled(function, y)[0] for name, function in functions.items()}
    return interleaved(runs, repeats)
