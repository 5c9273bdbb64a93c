"""The arguments of trajectory optimization, and the states from which it starts."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._base.shapes import are_alike, shapes
from .._base.types import Y
from .._constraint.checks import check_state
from .._constraint.constraint import AbstractConstraint
from .._constraint.project import consistent_state
from .shooting import Knots, Shooting, solve_intervals
from .transcription import Evaluation


_ON_MANIFOLD = 1e-6  # how far a goal may be from the manifold, relative to its size


def check_setting(terms: Any, ts: Any, y0: Any, inputs: Any, steps: Any) -> None:
    if not isinstance(terms, dfx.ODETerm):
        raise TypeError(
            f"`terms` must be a `diffrax.ODETerm` whose `args` are the inputs, such as `system.terms`, got {type(terms).__name__}."
        )
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((ts, y0, inputs))):
        raise TypeError(
            "`optimize_trajectory` calls SciPy: call it outside of `jit`, `vmap` and derivatives."
        )
    if not isinstance(steps, int) or steps < 2 or steps % 2:
        raise ValueError(f"`steps` must be an even number of at least 2, got {steps!r}.")
    check_state(y0, "y0")
    if any(jnp.result_type(leaf) != np.float64 for leaf in jtu.tree_leaves(y0)):
        raise ValueError(
            "`y0` must be in double precision, which optimizers need: `jax.config.update('jax_enable_x64', True)`."
        )


def checked_inputs(ts: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
    ts, inputs = np.asarray(ts, float), np.asarray(inputs, float)
    if ts.ndim != 1 or ts.size < 3 or not np.all(np.diff(ts) > 0):
        raise ValueError(f"`ts` must be at least three increasing times, shape (K,), got {ts}.")
    is_table = inputs.ndim == 2 and inputs.shape[0] == ts.size and inputs.size > 0
    if not is_table or not np.all(np.isfinite(inputs)):
        raise ValueError(
            f"`inputs` must be finite and have the shape ({ts.size}, m) for m inputs, got {inputs.shape}."
        )
    return ts, inputs


def checked_bounds(bounds: Any, m: int) -> np.ndarray:
    """Return lower and upper bounds, shape `(2, m)`."""
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError("`bounds` must be `(lower, upper)`, two numbers or arrays of shape (m,).")
    shape = ", ".join(str(np.shape(side)) for side in bounds)
    if any(np.shape(side) not in ((), (m,)) for side in bounds):
        raise ValueError(f"`bounds` must be two numbers, or arrays of shape ({m},), got {shape}.")
    limits = np.stack([np.broadcast_to(np.asarray(side, float), (m,)) for side in bounds])
    if not np.all(limits[0] < limits[1]):
        raise ValueError(f"`bounds`: each lower bound must be below the upper one, got {bounds}.")
    return limits


def check_number(name: str, function: Any, *args: Any) -> None:
    if not callable(function):
        raise TypeError(f"`{name}` must be a function, got {type(function).__name__}.")
    out = eqx.filter_eval_shape(function, *args)
    if getattr(out, "shape", np.shape(out) if isinstance(out, int | float) else None) != ():
        raise ValueError(f"`{name}` must return one number, got {shapes(out)}.")


def check_path_constraint(function: Any, *args: Any) -> None:
    if not callable(function):
        raise TypeError(f"`path_constraint` must be a function, got {type(function).__name__}.")
    out = eqx.filter_eval_shape(function, *args)
    if getattr(out, "ndim", 2) > 1:
        raise ValueError(
            f"`path_constraint` must return a number or an array of shape (s,), got {shapes(out)}."
        )


def checked_goal(goal: Y, y0: Y, constraint: AbstractConstraint, t: Any, u: Any) -> Y:
    if not are_alike(goal, y0):
        raise ValueError(
            f"`goal` must be a state like `y0`, of shapes {shapes(y0)}, or a function of a state; got {shapes(goal)}."
        )
    goal = jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), goal, y0)
    there, info = consistent_state(constraint, t, goal, u, throw=False)
    if not bool(info.success) or not float(info.correction) <= _ON_MANIFOLD:
        raise ValueError(
            "`goal` is not on the manifold. Write `goal, _ = mj.consistent_state(constraint, ts[-1], goal)` if it is near."
        )
    return there


def check_periodic(
    goal_is_state: bool, y0: Y, constraint: AbstractConstraint, t: Any, u: Any
) -> None:
    if goal_is_state:
        raise ValueError(
            "`goal` must be a function or None where `periodic=True`: the last state is the first one."
        )
    _, info = consistent_state(constraint, t, y0, u, throw=False)
    if not bool(info.success) or not float(info.correction) <= _ON_MANIFOLD:
        raise ValueError(
            "`periodic=True` needs a `constraint` that is the same at the first and the last of `ts`: `y0` does not satisfy it "
            "at the last one. Let `ts` end where the constraint repeats."
        )


def check_guess(ts: np.ndarray, now: Evaluation) -> None:
    """Refuse a guess from which no optimizer can start, and say why."""
    ends, last, path = now.ends, now.last, now.path
    is_finite = lambda *parts: np.all(
        [np.isfinite(x).all(axis=tuple(range(1, x.ndim))) for x in parts], axis=0
    )
    solved = is_finite(ends.reached[:, :-1], ends.by_p[:, :-1])
    if not solved.all():
        raise ValueError(
            f"The motion from t = {ts[np.argmin(solved)]:.6g} on, or its derivative, is not finite with the guessed states and "
            "inputs. Give other `states` or `inputs`, or more `steps`; a norm has no derivative at zero."
        )
    if not is_finite(ends.reached[:, -1:], ends.by_p[:, -1:]).all():
        raise ValueError(
            "`cost` or its derivative is not finite with the guessed states and inputs. A norm has no derivative at zero: square "
            "it, or give other `inputs`."
        )
    if not is_finite(last.values, last.by_z).all():
        raise ValueError(
            "`final_cost` or `goal`, or the derivative of one of them, is not finite at the last of the guessed `states`."
        )
    allowed = is_finite(*path)
    if not allowed.all():
        raise ValueError(
            f"`path_constraint` or its derivative is not finite at t = {ts[np.argmin(allowed)]:.6g} with the guessed states and "
            "inputs. A norm has no derivative at zero: square it, or give other `states`."
        )
    slopes = last.by_z[1:]
    if (
        slopes.size
        and np.linalg.matrix_rank(slopes, tol=1e-9 * np.abs(slopes).max()) < slopes.shape[0]
    ):
        raise ValueError(
            f"`goal` returns {slopes.shape[0]} numbers that depend on each other on the manifold, at the last of the guessed "
            "`states`. Return independent ones, or give the state that is the goal."
        )


def guess_states(
    shooting: Shooting, ts: np.ndarray, y0: Y, u: np.ndarray, goal: Any, states: Any
) -> np.ndarray:
    """Return states on the manifold at all times, as vectors."""
    first, unravel = jfu.ravel_pytree(y0)
    last = None if goal is None else jfu.ravel_pytree(goal)[0]
    if states is not None:
        wanted = jtu.tree_map(lambda leaf: jnp.zeros((ts.size, *leaf.shape), leaf.dtype), y0)
        if not are_alike(states, wanted):
            raise ValueError(
                f"`states` must have the shapes {shapes(wanted)}, got {shapes(states)}."
            )
        states = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(states)
    found, x = [first], first
    for k in range(1, ts.size):
        if states is not None:
            near = states[k]
        elif last is not None:
            near = x + (last - x) / (ts.size - k)
        else:
            start, pair = (
                Knots(x[None], jnp.zeros((1, x.size, 0))),
                jnp.asarray(u[None, k - 1 : k + 1]),
            )
            times = jnp.asarray(ts[None, k - 1 : k + 1])
            near = solve_intervals(shooting, times, start, pair).reached[0, :-1]
        y, info = consistent_state(shooting.constraint, ts[k], unravel(near), u[k], throw=False)
        if not bool(info.success):
            raise ValueError(
                f"No guess of the state at t = {ts[k]:.6g} was found on the manifold. Give `states`, near to the manifold at "
                "all of `ts`."
            )
        x = jfu.ravel_pytree(y)[0]
        found.append(x)
    if last is not None:
        found[-1] = last
    return np.stack(found)
