"""Networks of `benchmarks.peers.neural`, and how they are trained: by Levenberg-Marquardt on all intervals of
all orbits, of which the solution is known exactly."""

import time
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.linalg import solve as solve_linear

import manifold_jax as mj

from ._neural_systems import System


WIDTH, DEPTH = 32, 2
TRAINING_ORBITS = 40
GAIN = 8.0  # of the stabilization, that of the publication
PARTS = 8  # of the intervals, whose derivatives are in memory at once
DAMPING, LARGEST_DAMPING, SMALLEST_DAMPING = 0.1, 1e8, 1e-14


def solve(system: System, approach: str, network: Any, y0: Any, ts: Any, **options) -> dfx.Solution:
    """Solve the learned equation from `y0`, with the quantities kept that it starts with."""
    constraint = mj.Invariants(system.conserved, y0=y0, t0=ts[0])
    field, solver, diffeqsolve = system.field, dfx.Tsit5(), dfx.diffeqsolve
    if approach == "stabilized":
        gain = mj.InvariantStabilization(GAIN)
        solver, diffeqsolve = mj.Stabilized(solver, constraint, stabilization=gain), mj.diffeqsolve
    if approach == "projected":
        field = mj.tangent_field(field, constraint)
        solver, diffeqsolve = mj.Projected(solver, constraint), mj.diffeqsolve
    return diffeqsolve(
        dfx.ODETerm(field),
        solver,
        ts[0],
        ts[-1],
        y0=y0,
        args=network,
        saveat=dfx.SaveAt(ts=ts),
        throw=False,
        **options,
    )


def train(system: System, approach: str, iterations: int, seed: int) -> tuple[Any, float, float]:
    """Return the network, the mean square of its errors after one interval, and the seconds it took."""
    begin = time.perf_counter()
    times = np.arange(0, system.span, system.interval)
    orbits = system.orbits(np.random.default_rng(seed), TRAINING_ORBITS, times)
    key = jax.random.PRNGKey(seed)
    network = eqx.nn.MLP(system.inputs, system.outputs, WIDTH, DEPTH, jnp.tanh, key=key)
    arrays, static = eqx.partition(network, eqx.is_array)
    weights, unravel = ravel_pytree(arrays)
    rebuild = lambda weights: eqx.combine(unravel(weights), static)
    squares, normal_equations = make_objective(system, approach, rebuild, orbits, times)
    weights, loss = levenberg_marquardt(squares, normal_equations, weights, iterations)
    count = orbits[:, 1:].size
    return rebuild(weights), loss / count, time.perf_counter() - begin


def make_objective(
    system: System, approach: str, rebuild: Callable, orbits: np.ndarray, times: np.ndarray
) -> tuple[Callable, Callable]:
    """Return compiled functions of the weights: the sum of squared residuals; and that with Gauss-Newton matrix
    and gradient, half of the second derivatives and half of the first."""
    options = dict(
        dt0=system.interval / system.substeps,
        stepsize_controller=dfx.ConstantStepSize(),
        max_steps=system.substeps + 1,
    )

    def residual(weights, piece):
        t, before, after = piece
        ts = jnp.stack([t, t + system.interval])
        return solve(system, approach, rebuild(weights), before, ts, **options).ys[-1] - after

    start = np.broadcast_to(times[:-1], (len(orbits), len(times) - 1))
    parts = jax.tree.map(in_parts, (start, orbits[:, :-1], orbits[:, 1:]))
    of_part = jax.vmap(residual, (None, 0))

    @jax.jit
    def squares(weights):
        return jnp.sum(jax.lax.map(lambda part: jnp.sum(of_part(weights, part) ** 2), parts))

    @jax.jit
    def normal_equations(weights):
        def add(sums, part):
            r = of_part(weights, part).reshape(-1)
            J = jax.vmap(jax.jacrev(residual), (None, 0))(weights, part).reshape(len(r), -1)
            return jax.tree.map(jnp.add, sums, (r @ r, J.T @ J, J.T @ r)), None

        n = weights.size
        zeros = jnp.zeros(()), jnp.zeros((n, n)), jnp.zeros(n)
        return jax.lax.scan(add, zeros, parts)[0]

    return squares, normal_equations


def in_parts(x: np.ndarray) -> jax.Array:
    """Join the first two axes, orbits and intervals, and split them in parts of one size; a few intervals are left out."""
    flat = x.reshape(-1, *x.shape[2:])
    size = len(flat) // PARTS
    return jnp.asarray(flat[: PARTS * size].reshape(PARTS, size, *flat.shape[1:]))


def levenberg_marquardt(
    squares: Callable, normal_equations: Callable, weights: Any, iterations: int
) -> tuple[Any, float]:
    """Return the weights and the sum of squares there."""
    weights, damping = np.asarray(weights), DAMPING
    for _ in range(iterations):
        value, matrix, gradient = (np.asarray(part) for part in normal_equations(weights))
        while damping < LARGEST_DAMPING:
            damped = matrix + damping * np.eye(len(weights))
            step = solve_linear(damped, -gradient, assume_a="pos")
            if float(squares(weights + step)) < value:
                weights, damping = weights + step, max(damping / 3, SMALLEST_DAMPING)
                break
            damping *= 4
    return weights, float(squares(weights))
