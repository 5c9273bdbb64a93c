"""Optimal control on a manifold: the inputs for a motion, by multiple shooting."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.optimize as opt
from jaxtyping import Array, Bool, Float, Int

from .._base.numbers import numbers_as_arrays
from .._base.shapes import are_alike, shapes
from .._base.types import FloatScalar, RealScalarLike, Y
from .._constraint.checks import check_constraint_type, check_state
from .._constraint.constraint import AbstractConstraint
from .._constraint.project import consistent_state
from .quasi_newton import minimize
from .shooting import Charts, Knots, Shooting, solve_intervals
from .transcription import Transcription


_ON_MANIFOLD = 1e-6  # how far a goal may be from the manifold, relative to its size
_CLOSED, _EXACT = 1e-6, 1e-3  # largest gaps and integration errors of a motion that is found


class OptimalTrajectory(eqx.Module):
    """What [`optimize_trajectory`][manifold_jax.optimize_trajectory] returns; called with a time, it returns the
    inputs then, shape `(m,)`: linear between the times, constant before and after.

    **Attributes:**

    - `ts`, `ys`, `inputs`: the motion at the `K` times, all states on the manifold.
    - `cost`: the integral and the final cost.
    - `gap`: the largest difference of a state from the end of the interval before it, relative to `|y| + 1`.
    - `integration_error`: by how much the end of an interval changes with twice as many steps, in the same way.
    - `success`, and `message`, which says what is wrong.
    - `num_iterations`, `num_evaluations`: of the optimizer, and how often all intervals were solved.
    """

    ts: Float[Array, " K"]
    ys: Y
    inputs: Float[Array, "K m"]
    cost: FloatScalar
    gap: FloatScalar
    integration_error: FloatScalar
    success: Bool[Array, ""]
    num_iterations: Int[Array, ""]
    num_evaluations: Int[Array, ""]
    message: str = eqx.field(static=True)

    def __call__(self, t: RealScalarLike) -> Float[Array, " m"]:
        return jax.vmap(lambda values: jnp.interp(t, self.ts, values), 1)(self.inputs)


@numbers_as_arrays("y0")
def optimize_trajectory(
    terms: dfx.ODETerm,
    constraint: AbstractConstraint,
    ts: Any,
    y0: Y,
    inputs: Any,
    *,
    cost: Callable[[RealScalarLike, Y, Any], Any],
    final_cost: Callable[[Y], Any] | None = None,
    goal: Any = None,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    states: Y | None = None,
    solver: dfx.AbstractSolver | None = None,
    steps: int = 4,
    max_iterations: int = 500,
    tolerance: float = 1e-8,
    throw: bool = True,
) -> OptimalTrajectory:
    r"""Find the inputs `u(t)`, linear between given times, that minimize

    $$\int_{t_0}^{t_1} c(t, y, u)\,dt + c_1(y(t_1)), \qquad y' = f(t, y, u), \quad g(t, y) = 0, \quad
    \underline u \le u \le \overline u,$$

    from `y0`, to a goal. Multiple shooting: the states at the times are unknowns, too, as tangent coordinates
    in charts of the manifold, so that they and all states between them satisfy the constraint at every iterate;
    the gaps between each interval and the next one are closed at the solution.

    ```python
    plant = robot(lambda t, y, args: args)  # an assembly with a Controller whose inputs are `args`
    found = mj.optimize_trajectory(plant.system.terms, plant.system.constraint, ts, y0, jnp.zeros((ts.size, 2)),
                                   cost=lambda t, y, u: u @ u, goal=y1, bounds=(-1.4, 1.4))
    driven = robot(lambda t, y, args: found(t))
    ```

    **Arguments:**

    - `terms`: a `diffrax.ODETerm` whose `args` are the inputs `u`, shape `(m,)`. Other parameters are closed over.
    - `constraint`: the manifold, which does not depend on the inputs.
    - `ts`: the `K` times, increasing; about as many as are needed to draw the motion by hand.
    - `y0`: the first state, made consistent.
    - `inputs`: a guess of the inputs, shape `(K, m)`; zeros do.
    - `cost`: `c(t, y, u)`, one number; its integral is that of Simpson's rule.
    - `final_cost`: `c_1(y)`, one number.
    - `goal`: the last state, on the manifold; or a function of it that returns an array of what must be zero.
    - `bounds`: lower and upper bounds of the inputs, numbers or of shape `(m,)`; infinite without.
    - `states`: a guess of the states, with a leading axis of `K`; by default on the way from `y0` straight
        to the goal, or without a state as goal those of the guessed inputs. For a motion that has to
        take a detour, such as a swing to and fro, give one.
    - `solver`: an explicit solver of Diffrax, by default `Tsit5()`.
    - `steps`: how many equal steps are made in each interval, an even number. Look at `integration_error`:
        an optimizer finds the inputs for which a coarse solve is most wrong.
    - `max_iterations`, `tolerance`: of the optimizer; `tolerance` is for the gradient of the Lagrangian.
    - `throw`: raise if no motion is found. Otherwise look at `success`.

    **Returns:** an [`OptimalTrajectory`][].

    **Raises** `ValueError` or `TypeError` for arguments that cannot work, and with `throw` a `RuntimeError` if
    the gaps do not close (the goal may be out of reach), if the optimizer does not end, or if the steps
    are too coarse.

    The solution is a local minimum. The optimizer is SciPy's `trust-constr`, with first derivatives in forward
    mode; for hundreds of states or times, or bounds on states, write the equations in CasADi for IPOPT. Not
    inside `jit`. Feedback along the motion: [`regulate`][].

    Source: Bock & Plitt, IFAC Proc. 17 (1984) 1603-1608 (multiple shooting); Bordalba, Schoels, Ros, Porta & Diehl,
    IEEE Trans. Robot. 39 (2023) 183-202 (charts at the knots).
    """
    check_constraint_type(constraint)
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((ts, y0, inputs))):
        raise TypeError(
            "`optimize_trajectory` calls SciPy: call it outside of `jit`, `vmap` and derivatives."
        )
    if not isinstance(steps, int) or steps < 2 or steps % 2:
        raise ValueError(f"`steps` must be an even number of at least 2, got {steps!r}.")
    ts, u = _checked_inputs(ts, inputs)
    limits = _checked_bounds(bounds, u.shape[1])
    check_state(y0, "y0")
    y0, _ = consistent_state(constraint, ts[0], jtu.tree_map(jnp.asarray, y0), u[0])
    _check_number("cost", cost, ts[0], y0, u[0])
    if final_cost is not None:
        _check_number("final_cost", final_cost, y0)
    is_state = goal is not None and not callable(goal)
    if is_state:
        goal = _checked_goal(goal, y0, constraint, ts[-1], u[-1])
    elif goal is not None and getattr(eqx.filter_eval_shape(goal, y0), "ndim", 2) > 1:
        raise ValueError(
            "`goal` must be a state like `y0`, or a function of a state that returns one array of shape (r,)."
        )
    shooting = Shooting(
        terms,
        constraint,
        dfx.Tsit5() if solver is None else solver,
        cost,
        _last(final_cost, None if is_state else goal),
        jfu.ravel_pytree(y0)[1],
        steps,
    )
    guess = _guess(shooting, ts, y0, u, goal if is_state else None, states)
    charts = Charts.around(shooting, ts, guess, u)
    transcription = Transcription.of(shooting, charts, u.shape[1], ends_free=not is_state)
    found = _solved(transcription, u, limits, max_iterations, tolerance)
    if throw and not found.success:
        raise RuntimeError(found.message)
    return found


def _checked_inputs(ts: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
    ts, inputs = np.asarray(ts, float), np.asarray(inputs, float)
    if ts.ndim != 1 or ts.size < 3 or not np.all(np.diff(ts) > 0):
        raise ValueError(f"`ts` must be at least three increasing times, shape (K,), got {ts}.")
    if inputs.ndim != 2 or inputs.shape[0] != ts.size or not np.all(np.isfinite(inputs)):
        raise ValueError(
            f"`inputs` must be finite and have the shape ({ts.size}, m) for m inputs, got {inputs.shape}."
        )
    return ts, inputs


def _checked_bounds(bounds: Any, m: int) -> np.ndarray:
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


def _check_number(name: str, function: Any, *args: Any) -> None:
    if not callable(function):
        raise TypeError(f"`{name}` must be a function, got {type(function).__name__}.")
    out = eqx.filter_eval_shape(function, *args)
    if getattr(out, "shape", None) != ():
        raise ValueError(f"`{name}` must return one number, got {shapes(out)}.")


def _checked_goal(goal: Y, y0: Y, constraint: AbstractConstraint, t: Any, u: Any) -> Y:
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


def _last(final_cost: Any, goal: Any) -> Callable[[Y], Array]:
    def last(y: Y) -> Array:
        value = jnp.zeros(()) if final_cost is None else final_cost(y)
        rest = jnp.zeros(0) if goal is None else jnp.atleast_1d(goal(y))
        return jnp.append(value, rest)

    return last


def _guess(
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
    none = jnp.zeros((0, 0))
    for k in range(1, ts.size):
        if states is not None:
            near = states[k]
        elif last is not None:
            near = x + (last - x) / (ts.size - k)
        else:
            pair = jnp.asarray(u[None, k - 1 : k + 1]), Charts(none[0], x[None], x[None, :, None])
            start = Knots(x[None], jnp.zeros((1, x.size, 0)))
            near = solve_intervals(shooting, jnp.asarray(ts[None, k - 1 : k + 1]), start, *pair).x[
                0
            ]
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


def _solved(
    transcription: Transcription,
    u: np.ndarray,
    limits: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> OptimalTrajectory:
    T, places = transcription, transcription.inputs
    v, lower, upper = np.zeros(T.size), np.full(T.size, -np.inf), np.full(T.size, np.inf)
    v[places], lower[places], upper[places] = np.clip(u, *limits), limits[0], limits[1]
    bad = ~np.isfinite(T.at(v).ends.reached).all(axis=1)
    if bad.any():
        raise ValueError(
            f"The motion from t = {float(T.charts.ts[np.argmax(bad)]):.6g} on cannot be solved with the guessed states and inputs. "
            "Give other `states` or `inputs`, or more `steps`."
        )
    T, result = minimize(T, v, opt.Bounds(lower, upper), max_iterations, tolerance)
    v = np.clip(result.x, lower, upper)
    now, measured = T.at(v), _measured(T, v)
    message = _message(result, *measured)
    ys = jax.vmap(T.shooting.unravel)(jnp.asarray(now.knots.x))
    counts = jnp.asarray(result.nit), jnp.asarray(T.evaluations)
    numbers = map(jnp.asarray, (T.cost(v), measured.gap, measured.error, not message))
    return OptimalTrajectory(T.charts.ts, ys, jnp.asarray(now.u), *numbers, *counts, message)


class Measured(NamedTuple):
    """How well the intervals fit together, where they do least, and how well they are solved."""

    gap: float
    at: float
    error: float


def _measured(T: Transcription, v: np.ndarray) -> Measured:
    now, ends = T.at(v), Charts(*(leaf[1:] for leaf in T.charts))
    size = 1 + np.abs(now.knots.x).max()
    gaps = np.abs(now.ends.x - now.knots.x[1:]).max(axis=1) / size
    ts, u = np.asarray(T.charts.ts), now.u
    middle, between = (ts[1:] + ts[:-1]) / 2, (u[1:] + u[:-1]) / 2
    x, by_z = now.knots.x[:-1], now.knots.by_z[:-1]
    for times, pairs in (
        ((ts[:-1], middle), (u[:-1], between)),
        ((middle, ts[1:]), (between, u[1:])),
    ):
        given = (
            np.stack(times, axis=1),
            Knots(jnp.asarray(x), jnp.asarray(by_z)),
            np.stack(pairs, axis=1),
        )
        x = solve_intervals(T.shooting, *jtu.tree_map(jnp.asarray, given), ends).x
    error = float(np.abs(np.asarray(x) - now.ends.x).max() / size)
    worst = int(np.argmax(np.nan_to_num(gaps, nan=np.inf)))
    return Measured(float(gaps[worst]), float(ts[worst + 1]), error)


def _message(result: opt.OptimizeResult, gap: float, at: float, error: float) -> str:
    """Return what is wrong with a result, nothing if it can be used."""
    residual = float(result.constr_violation)
    if not max(gap, residual) <= _CLOSED:
        return (
            f"No motion was found: after {result.nit} iterations the parts of the motion are {max(gap, residual):.2g} apart, most at "
            f"t = {at:.6g}. The goal may be out of reach within `bounds` and the time; otherwise give `states` or "
            "`inputs` that are nearer to a motion, or more `max_iterations`."
        )
    if not error <= _EXACT:
        return f"The steps are too coarse: twice as many change the motion by {error:.2g}. Write more `steps`, or give more times."
    if result.status not in (1, 2):
        return f"The motion is possible, but its cost may still fall: {result.nit} iterations are made. Write more `max_iterations`."
    return ""
