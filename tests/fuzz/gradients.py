"""Checks of gradients: reverse against forward mode, and against differences of solutions."""

import functools
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from .checks import Fault, Judge
from .families import Args
from .lanes import FAILING, gradient_directions, Lanes, moved_lanes, reference_paths, take
from .program import FRACTIONS, solve
from .structure import IMPLICIT, SPLIT, Structure


# Lanes of which gradients are taken.
COUNT = 6
REVERSE_LIMIT = 1e-9
# Of second derivatives, which amplify more.
SECOND_LIMIT = 1e-7
ADJOINTS = {
    "default": mj.StepReplayAdjoint,
    "few states": functools.partial(mj.StepReplayAdjoint, checkpoints=4),
    "direct": dfx.DirectAdjoint,
}


def check_gradients(
    structure: Structure, lanes: Lanes, failing: Lanes, judge: Judge
) -> tuple[list[Fault], dict[str, float]]:
    """Of the first lanes, one of which fails in `failing`."""
    lanes, failing = take(lanes, slice(COUNT)), take(failing, slice(COUNT))
    trusted = judge.trusted[:COUNT]
    directions = gradient_directions(structure, lanes)
    forward = jax.jit(jax.vmap(_forward(structure)))
    reverse = jax.jit(jax.vmap(_reverse(structure)))
    slope = np.asarray(forward(lanes, directions))
    backward, okay = map(np.asarray, reverse(lanes, directions))
    trusted = trusted & okay
    faults = []
    if not np.all(np.isfinite(slope[trusted])) or not np.all(np.isfinite(backward[trusted])):
        return [Fault("gradient", "not finite")], {}
    if not _raises_upstream(structure):
        spoilt = np.asarray(reverse(failing, directions)[0])
        others = np.flatnonzero(trusted & (np.arange(len(slope)) != FAILING))
        if not np.array_equal(backward[others], spoilt[others]):
            faults.append(Fault("lanes", "gradients of other lanes change with a failing lane"))
    scale = _scale(structure, lanes, directions)
    ways = np.max(np.abs(slope - backward)[trusted] / scale[trusted], initial=0.0)
    if ways > REVERSE_LIMIT:
        text = f"reverse and forward mode differ by {ways:.1e}"
        faults.append(Fault("gradient", text))
    numbers = {"reverse": float(ways)}
    if structure.reverse in (None, "default"):
        faults += _check_second(structure, lanes, directions, trusted, numbers)
    expected, bound = _expected(structure, lanes, directions, judge)
    if expected is not None:
        error = np.abs(slope - expected) / scale
        numbers["differences"] = float(np.max(error[trusted], initial=0.0))
        wrong = np.flatnonzero(trusted & (error > bound))
        if wrong.size > 0:
            text = f"{slope[wrong[0]]:.6g} by forward mode, {expected[wrong[0]]:.6g} by differences"
            faults.append(Fault("gradient", f"{text}, lane {wrong[0]}"))
    return faults, numbers


def _check_second(
    structure: Structure, lanes: Lanes, directions: Args, trusted: np.ndarray, numbers: dict
) -> list[Fault]:
    """Second derivatives, forward over forward mode against forward over reverse mode."""
    reverse = _reverse(structure)
    backward = jax.jit(jax.vmap(_along(lambda lane, along: reverse(lane, along)[0])))
    forward = jax.jit(jax.vmap(_along(_forward(structure))))
    one, other = (np.asarray(f(lanes, directions))[trusted] for f in (forward, backward))
    if not np.all(np.isfinite(one)) or not np.all(np.isfinite(other)):
        return [Fault("gradient", "second derivatives are not finite")]
    ways = np.max(np.abs(one - other) / np.maximum(np.abs(one), 1.0), initial=0.0)
    numbers["second"] = float(ways)
    if ways <= SECOND_LIMIT:
        return []
    return [Fault("gradient", f"second derivatives in two orders of modes differ by {ways:.1e}")]


def _along(slope: Any) -> Any:
    """The derivative of a slope along the same direction."""

    def second(lane, direction):
        chosen = {name: lane["args"][name] for name in direction}
        at = lambda parameters: slope(_with(lane, parameters), direction)
        return jax.jvp(at, (chosen,), (direction,))[1]

    return second


def _raises_upstream(structure: Structure) -> bool:
    """Whether the gradient of a plain Diffrax solve, too, raises for all lanes: NaN in a linear
    solve of implicit stages or of the time of an event. Accelerations are NaN without constraints
    that determine them."""
    solves = structure.solver in IMPLICIT + SPLIT or structure.output == "event"
    return solves and (structure.family.mechanical or structure.failing.startswith("nan"))


def _loss(structure: Structure, adjoint: Any, lane: Any) -> Any:
    """A weighted sum of all values returned, and whether the solve succeeded."""
    out = solve(structure, adjoint)(lane)
    used = jnp.isfinite(out["times"])[:, None]
    weights = jnp.cos(1 + jnp.arange(out["states"].shape[1]))
    return jnp.sum(jnp.where(used, out["states"], 0) * weights), out["code"] < 2


def _with(lane: Any, parameters: Args) -> Any:
    return lane | {"args": lane["args"] | parameters}


def _forward(structure: Structure) -> Any:
    """The slope along a direction."""

    def slope(lane, direction):
        chosen = {name: lane["args"][name] for name in direction}
        loss = lambda parameters: _loss(structure, dfx.ForwardMode(), _with(lane, parameters))[0]
        return jax.jvp(loss, (chosen,), (direction,))[1]

    return slope


def _reverse(structure: Structure) -> Any:
    """The slope along a direction, from the gradient, and whether the solve succeeded."""
    adjoint = ADJOINTS[structure.reverse or "default"]()

    def slope(lane, direction):
        chosen = {name: lane["args"][name] for name in direction}
        loss = lambda parameters: _loss(structure, adjoint, _with(lane, parameters))
        gradient, okay = jax.grad(loss, has_aux=True)(chosen)
        return sum(jnp.vdot(gradient[name], direction[name]) for name in direction), okay

    return slope


def _path_changes(
    structure: Structure, lanes: Lanes, directions: Args, s: np.ndarray, h: float
) -> np.ndarray:
    """Derivatives of the solutions along the directions, by differences of SciPy's."""
    moved = [moved_lanes(structure, lanes, directions, sign * h) for sign in (1, -1)]
    ends = [reference_paths(structure, each)(s) for each in moved]
    return (ends[0] - ends[1]) / (2 * h)


def _scale(structure: Structure, lanes: Lanes, directions: Args) -> np.ndarray:
    """Sizes of the derivatives, so that cancellation in the weighted sum does not matter."""
    changes = _path_changes(structure, lanes, directions, FRACTIONS, 1e-4)
    return np.maximum(np.max(np.abs(changes), axis=(0, 2)), 1e-3)


def _expected(
    structure: Structure, lanes: Lanes, directions: Args, judge: Judge
) -> tuple[np.ndarray | None, Any]:
    """The slope from elsewhere, and how much it may differ: of the exact solution if the steps
    are adaptive, of the same program with other parameters if they are given."""
    growth = judge.growth[: len(lanes["y0"])]
    weights = np.cos(1 + np.arange(structure.family.n))
    if structure.is_adaptive:
        if structure.output in ("steps", "event"):
            return None, None
        s = np.array([1.0]) if structure.output == "t1" else FRACTIONS
        changes = _path_changes(structure, lanes, directions, s, 1e-4)
        return (changes @ weights).sum(axis=0), 300 * structure.tolerance * growth**2 + 1e-5 + (
            judge.between if structure.output != "t1" else 0
        )
    if structure.output == "event" or structure.approach == "partition":
        return None, None  # which coordinates are chosen may change in between
    h = 1e-5
    program = jax.jit(jax.vmap(lambda lane: _loss(structure, None, lane)[0]))
    ends = [program(moved_lanes(structure, lanes, directions, k * h)) for k in (1, -1, 2, -2)]
    up, down, up2, down2 = (np.asarray(end) for end in ends)
    slope = (8 * (up - down) - (up2 - down2)) / (12 * h)
    return slope, (1e-4 if structure.solver in IMPLICIT + SPLIT else 1e-6) * growth**2
