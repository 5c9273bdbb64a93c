"""Records cut into pieces for multiple shooting, with a chart at the start of each."""

import dataclasses
from typing import Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._constraint.checks import check_constraint, has_no_equations
from .._constraint.constraint import Invariants
from .._constraint.residual import jacobian, residual_vector
from .data import filled_in_time, flatten, Records
from .model import at_start, Piece, Simulator


def make_pieces(
    records: Records, segments: int, simulator: Simulator, states: Any, free_start: bool
) -> Piece:
    """Cut all records into pieces, those of one record next to each other.

    A piece ends where the next one begins; the measurement at that time belongs to the next.
    """
    R, T = records.ts.shape
    if type(segments) is not int or not 1 <= segments < T:
        raise ValueError(
            f"`segments` must be a whole number from 1 to {T - 1} (the intervals of `ts`), "
            f"got {segments!r}."
        )
    edges = edges_of(T, segments)
    length = np.max(np.diff(edges)) + 1
    index = np.minimum(edges[:-1, None] + np.arange(length), edges[1:, None])  # (S, L)
    own = edges[:-1, None] + np.arange(length) < edges[1:, None]
    own[-1] |= edges[-2] + np.arange(length) == T - 1
    first = np.arange(segments) == 0
    start = np.where(first, records.t0[:, None], records.ts[:, edges[:-1]])
    weights = records.weights[:, index] * own[None, :, :, None]
    guess = _guess(records, edges, simulator, states)
    basis = _charts(simulator, start, guess, needed=free_start or segments > 1)
    parts = dict(ts=records.ts[:, index], data=records.data[:, index], weights=weights)
    parts |= dict(start=start, guess=guess, basis=basis)
    merge = lambda a: jnp.asarray(a.reshape(R * segments, *a.shape[2:]), float)
    record = jnp.asarray(np.repeat(np.arange(R), segments))
    first = jnp.asarray(np.tile(first, R))
    return Piece(**jtu.tree_map(merge, parts), first=first, record=record)


def edges_of(times: int, segments: int) -> np.ndarray:
    """Return the indices of the times where pieces begin and end, shape `(segments + 1,)`."""
    return np.round(np.linspace(0, times - 1, segments + 1)).astype(int)


def _guess(records: Records, edges: np.ndarray, simulator: Simulator, states: Any) -> np.ndarray:
    """Return states at the starts of all pieces, `(R, S, n)`: given, measured, or simulated."""
    one = lambda r: jfu.ravel_pytree(simulator.given(r).y0)[0]
    first = jax.vmap(one)(jnp.arange(records.ts.shape[0]))[:, None]
    if edges.size == 2:
        return np.asarray(first)
    if states is not None:
        lead = records.ts.shape if records.many else records.ts.shape[1:]
        later = flatten(states, lead, simulator.given().y0, "states").reshape(*records.ts.shape, -1)
        if not np.all(np.isfinite(later)):
            raise ValueError("`states` must be finite: guesses of the states at all of `ts`.")
    elif simulator.observe is None:
        later = filled_in_time(records)
    else:
        later = _simulate(records, simulator, first[:, 0])
    return np.concatenate([first, later[:, edges[1:-1]]], axis=1)


def _simulate(records: Records, simulator: Simulator, y0: Any) -> np.ndarray:
    """Simulate trajectories with the start values of the parameters, for lack of a better guess."""
    whole = dataclasses.replace(simulator, observe=None)
    (R, T), n = records.ts.shape, y0.shape[1]
    empty, first = jnp.zeros((R, T, 0)), jnp.ones(R, bool)
    times = jnp.asarray(records.t0), jnp.asarray(records.ts)
    pieces = Piece(*times, empty, empty, y0, jnp.zeros((R, n, 0)), first, jnp.arange(R))
    u, adjoint = jnp.zeros_like(simulator.transform.start), dfx.ForwardMode()
    predicted = jax.vmap(lambda piece: whole.predict(u, piece, adjoint))(pieces)
    if np.any(predicted.failed):
        raise ValueError(
            f"`parameters`: the solve of record {np.argmax(predicted.failed)} from the start values "
            "fails, so that the states at the `segments` cannot be guessed. Pass them in `states`."
        )
    return np.asarray(predicted.observed)


def _charts(simulator: Simulator, start: np.ndarray, guess: np.ndarray, needed: bool) -> np.ndarray:
    """Return orthonormal bases of the tangent spaces at all guesses, `(R, S, n, d)`.

    `d` is the dimension of the manifold, of the whole space for conserved quantities, whose values
    belong to the initial state. `d = 0` if no states are unknown.
    """
    R, S, n = guess.shape
    setting = simulator.given()
    given = setting.constraint, start[0, 0], setting.y0, setting.args
    is_free = has_no_equations(*given)
    if not is_free:
        check_constraint(*given)
    if not needed:
        return np.zeros((R, S, n, 0))
    if is_free or isinstance(setting.constraint, Invariants):
        return np.broadcast_to(np.eye(n), (R, S, n, n))
    unravel = jfu.ravel_pytree(setting.y0)[1]

    def rows(t: Any, x: Any) -> Any:
        constraint = at_start(setting.constraint, t, unravel(x), setting.args)
        g = lambda x: residual_vector(constraint, t, unravel(x), setting.args)
        return jacobian(g, x)[1]

    G = np.asarray(jax.vmap(jax.vmap(rows))(jnp.asarray(start), jnp.asarray(guess)))
    _, s, Vt = np.linalg.svd(G)
    rank = int(np.max(np.sum(s > 1e-8 * s[..., :1], axis=-1)))
    return np.swapaxes(Vt[..., rank:, :], -1, -2)
