"""What NumPy and SciPy say: solutions, violations and steps of Runge-Kutta methods.

All draws are integrated as one system, over the fraction `s` of their runs."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.integrate

from .families import Args, conditions, Family


TOLERANCE = 1e-12
# Most evaluations of the field: a reference that needs more is given up.
MOST_EVALUATIONS = 20_000


class NoReferenceError(Exception):
    """SciPy has no solution, either."""


# States of all lanes at fractions `s` of their runs, of shape `(len(s), lanes, n)`.
Paths = Callable[[np.ndarray], np.ndarray]


def solve(family: Family, args: Args, y0: np.ndarray, jumps: bool) -> Paths:
    """DOP853, or the exact solution where it is known. NaN in lanes without a solution."""
    start, length = args["start"], args["end"] - args["start"]
    if family.exact(args["end"], y0, args) is not None:
        return lambda s: np.stack([family.exact(start + x * length, y0, args) for x in s])
    try:
        return _together(family, args, y0, jumps)
    except NoReferenceError:
        if len(y0) == 1:
            return lambda s: np.full((len(s), *y0.shape), np.nan)
    half = len(y0) // 2
    parts = [
        solve(family, {name: value[part] for name, value in args.items()}, y0[part], jumps)
        for part in (slice(half), slice(half, None))
    ]
    return lambda s: np.concatenate([part(s) for part in parts], axis=1)


def _together(family: Family, args: Args, y0: np.ndarray, jumps: bool) -> Paths:
    """All lanes as one system, in pieces between the jumps."""
    start, length = args["start"], args["end"] - args["start"]
    jump = float(((args["jump_time"] - start) / length)[0])
    ends = [0.0, jump, 1.0] if jumps else [0.0, 1.0]
    pieces, y = [], y0
    for a, b in itertools.pairwise(ends):
        before = (a < jump) == (length > 0)  # in time, not along the run
        side = np.where(before, np.inf, -np.inf) if jumps else np.full(length.shape, np.inf)
        pieces.append(_piece(family, args | {"jump_time": side}, y, (a, b)))
        y = pieces[-1](b).reshape(y0.shape)

    def at(s: np.ndarray) -> np.ndarray:
        out = np.empty((len(s), *y0.shape))
        which = np.searchsorted(ends[1:-1], s, side="left")
        for k in np.unique(which):
            out[which == k] = np.moveaxis(pieces[k](s[which == k]), -1, 0).reshape(-1, *y0.shape)
        return out

    return at


def _piece(family: Family, args: Args, y0: np.ndarray, ends: tuple[float, float]) -> Any:
    start, length = args["start"], args["end"] - args["start"]
    evaluations = 0

    def rate(s: float, flat: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise NoReferenceError("too many steps")
        y = flat.reshape(y0.shape)
        return (family.field(np, start + s * length, y, args) * length[:, None]).ravel()

    try:
        sol = scipy.integrate.solve_ivp(
            rate, ends, y0.ravel(), "DOP853", dense_output=True, rtol=TOLERANCE, atol=TOLERANCE
        )
    except np.linalg.LinAlgError as error:
        raise NoReferenceError(str(error)) from error
    if not sol.success:
        raise NoReferenceError(sol.message)
    return sol.sol


def jacobian(family: Family, t: np.ndarray, y: np.ndarray, args: Args) -> np.ndarray:
    """By differences: good for sizes, and for directions to nine digits."""
    h = 1e-6 * np.maximum(1.0, np.abs(y))
    columns = []
    for j in range(y.shape[-1]):
        step = np.zeros_like(y)
        step[..., j] = h[..., j]
        rise = family.residual(np, t, y + step, args) - family.residual(np, t, y - step, args)
        columns.append(rise / (2 * h[..., j, None]))
    return np.stack(columns, axis=-1)


def violations(family: Family, t: np.ndarray, y: np.ndarray, args: Args) -> np.ndarray:
    """`max_i |g_i| / max_j |G_ij| (|y_j| + 1)` for each point."""
    G = jacobian(family, t, y, args)
    scale = np.max(np.abs(G) * (np.abs(y) + 1)[..., None, :], axis=-1)
    r = np.abs(family.residual(np, t, y, args))
    return np.max(r / np.where(scale > 0, scale, 1), axis=-1)


def regularity(family: Family, t: np.ndarray, y: np.ndarray, args: Args) -> np.ndarray:
    """How far the equations are from dependent, for each point."""
    return conditions(jacobian(family, t, y, args))


def on_manifold(family: Family, t: np.ndarray, y: np.ndarray, args: Args) -> np.ndarray:
    """The points `y + G(y)^T z` on the manifold, for `y` not far from it."""
    directions = np.swapaxes(jacobian(family, t, y, args), -1, -2)
    p = y
    for _ in range(8):
        r = family.residual(np, t, p, args)
        z = np.linalg.solve(jacobian(family, t, p, args) @ directions, r[..., None])
        p = p - (directions @ z)[..., 0]
    return p


def runge_kutta(
    family: Family, args: Args, y0: np.ndarray, grid: np.ndarray, tableau: Any
) -> np.ndarray:
    """States at the times of `grid`, fractions of the run, `(len(grid), lanes, n)`."""
    start, length = args["start"], args["end"] - args["start"]
    rate = lambda s, y: family.field(np, start + s * length, y, args) * length[:, None]
    c = np.concatenate([[0.0], tableau.c])
    states = [y0]
    for a, b in itertools.pairwise(grid):
        slopes: list[np.ndarray] = []
        for i, row in enumerate([np.zeros(0), *tableau.a_lower]):
            moved = sum((w * k for w, k in zip(row, slopes, strict=True)), np.zeros_like(y0))
            slopes.append(rate(a + c[i] * (b - a), states[-1] + (b - a) * moved))
        total = sum(w * k for w, k in zip(tableau.b_sol, slopes, strict=True))
        states.append(states[-1] + (b - a) * total)
    return np.stack(states)
