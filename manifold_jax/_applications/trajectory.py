"""Optimal control on a manifold: the inputs for a motion, by multiple shooting."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._base.numbers import numbers_as_arrays
from .._base.types import FloatScalar, RealScalarLike, Y
from .._constraint.checks import as_constraint, has_no_equations
from .._constraint.constraint import AbstractConstraint, NoConstraint
from .._constraint.project import consistent_state
from .quasi_newton import minimize
from .shooting import Charts, Shooting
from .trajectory_arguments import (
    check_guess,
    check_number,
    check_path_constraint,
    check_periodic,
    check_setting,
    checked_bounds,
    checked_goal,
    checked_inputs,
    guess_states,
)
from .trajectory_quality import measure, message_of
from .transcription import Transcription


class OptimalTrajectory(eqx.Module):
    """What [`optimize_trajectory`][manifold_jax.optimize_trajectory] returns; called with a time, it returns the
    inputs then, shape `(m,)`: linear between the times, constant before and after.

    **Attributes:**

    - `ts`, `ys`, `inputs`: the motion at the `K` times, all states on the manifold.
    - `cost`: the integral and the final cost.
    - `gap`: the largest difference of a state from the end of the interval before it, relative to `|y| + 1`.
    - `integration_error`: by how much the end of an interval changes with twice as many steps, in the same way, or
        the integral of the cost, relative to `1 + |cost|`; whichever is larger.
    - `success`: gaps and goal are closed and the path constraint is kept to 1e-6, `integration_error` is below 1e-3, and
        the optimizer has ended. Otherwise `message` says what is wrong.
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
    terms: Any,
    constraint: AbstractConstraint | None,
    ts: Any,
    y0: Y,
    inputs: Any,
    *,
    cost: Any,
    final_cost: Any = None,
    goal: Any = None,
    periodic: bool = False,
    path_constraint: Any = None,
    bounds: Any = (-np.inf, np.inf),
    states: Y | None = None,
    solver: dfx.AbstractSolver | None = None,
    steps: int = 4,
    max_iterations: int = 1000,
    tolerance: float = 1e-6,
    throw: bool = True,
) -> OptimalTrajectory:
    r"""Find the inputs `u(t)`, linear between given times, that minimize

    $$\int_{t_0}^{t_1} c(t, y, u)\,dt + c_1(y(t_1)), \qquad y' = f(t, y, u), \quad g(t, y) = 0, \quad
    h(t_k, y, u) \le 0, \quad \underline u \le u \le \overline u,$$

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
    - `constraint`: the manifold, which does not depend on the inputs, or `None` for all of the state space.
    - `ts`: the `K` times, increasing; about as many as are needed to draw the motion by hand.
    - `y0`: the first state, made consistent.
    - `inputs`: a guess of the inputs, shape `(K, m)`, clipped to `bounds`; zeros often do.
    - `cost`: `c(t, y, u)`, one number; its integral is that of Simpson's rule.
    - `final_cost`: `c_1(y)`, one number.
    - `goal`: the last state, on the manifold; or a function of it that returns an array of what must be
        zero: numbers that are independent on the manifold.
    - `periodic`: find a motion that ends with the state and the inputs with which it begins. `y0` is a guess then.
        Where nothing forbids it, the cheapest one may be rest: say by `path_constraint` where it passes.
    - `path_constraint`: `h(t, y, u)`, a number or an array of shape `(s,)` that must not be positive at any of `ts`:
        bounds on states, distances to obstacles, powers of motors. Between the times it is not looked at.
    - `bounds`: lower and upper bounds of the inputs, numbers or of shape `(m,)`; infinite without.
    - `states`: a guess of the states, with a leading axis of `K`; by default on the way from `y0` straight
        to the goal, or without a state as goal those of the guessed inputs. For a motion that has to
        take a detour, such as a swing to and fro, give one.
    - `solver`: an explicit solver of Diffrax, by default `Tsit5()`.
    - `steps`: how many equal steps are made in each interval, an even number. Look at `integration_error`:
        an optimizer finds the inputs for which a coarse solve is most wrong.
    - `max_iterations`, `tolerance`: of the optimizer, which ends where the gradient of the Lagrangian is zero, or the cost of
        a motion does not fall by more than `tolerance`, relative to `1 + |cost|`, in some fifty iterations.
    - `throw`: raise if no motion is found. Otherwise look at `success`.

    **Returns:** an [`OptimalTrajectory`][].

    **Raises** `ValueError` or `TypeError` for arguments that cannot work, and with `throw` a `RuntimeError` if
    the gaps do not close (the goal may be out of reach), if the optimizer does not end, or if the steps
    are too coarse.

    The solution is a local minimum. The optimizer is SciPy's `trust-constr`, with first derivatives in forward
    mode and second ones from updates; for hundreds of states or times write the equations in CasADi for IPOPT. Not
    inside `jit`. Feedback along the motion: [`regulate`][].

    Source: Bock & Plitt, IFAC Proc. 17 (1984) 1603-1608 (multiple shooting); Bordalba, Schoels, Ros, Porta & Diehl,
    IEEE Trans. Robot. 39 (2023) 183-202 (charts at the knots).
    """
    constraint = as_constraint(constraint, "optimize_trajectory(terms, constraint, ts, y0, inputs)")
    check_setting(terms, ts, y0, inputs, steps)
    ts, u = checked_inputs(ts, inputs)
    limits = checked_bounds(bounds, u.shape[1])
    if has_no_equations(constraint, ts[0], y0, u[0]):
        constraint = NoConstraint()
    y0, _ = consistent_state(constraint, ts[0], jtu.tree_map(jnp.asarray, y0), u[0])
    check_number("cost", cost, ts[0], y0, u[0])
    if final_cost is not None:
        check_number("final_cost", final_cost, y0)
    if path_constraint is not None:
        check_path_constraint(path_constraint, ts[0], y0, u[0])
    is_state = goal is not None and not callable(goal)
    if periodic:
        check_periodic(is_state, y0, constraint, ts[-1], u[0])
        u = np.append(u[:-1], u[:1], axis=0)
    if is_state:
        goal = checked_goal(goal, y0, constraint, ts[-1], u[-1])
    elif goal is not None and getattr(eqx.filter_eval_shape(goal, y0), "ndim", 2) > 1:
        raise ValueError(
            "`goal` must be a state like `y0`, or a function of a state that returns one array of shape (r,)."
        )
    shooting = Shooting(
        terms,
        constraint,
        dfx.Tsit5() if solver is None else solver,
        cost,
        _Last(final_cost, None if is_state else goal),
        _Path(path_constraint),
        jfu.ravel_pytree(y0)[1],
        steps,
    )
    guess = guess_states(shooting, ts, y0, u, goal if is_state else None, states)
    if periodic:
        guess[-1] = guess[0]
    charts = Charts.around(shooting, ts, guess, u)
    if charts.bases.shape[2] == 0:
        raise ValueError(
            "`constraint` has as many independent equations as `y0` has numbers: nothing can move."
        )
    transcription = Transcription.of(shooting, charts, u.shape[1], not is_state, periodic)
    found = _solved(transcription, u, limits, max_iterations, tolerance)
    if throw and not found.success:
        raise RuntimeError(found.message)
    return found


class _Last(eqx.Module):
    """The final cost and the residual of the goal, as one vector. A module, so that it is compiled once."""

    final_cost: Any
    goal: Any

    def __call__(self, y: Y) -> Float[Array, " r"]:
        value = jnp.zeros(()) if self.final_cost is None else self.final_cost(y)
        rest = jnp.zeros(0) if self.goal is None else jnp.atleast_1d(self.goal(y))
        return jnp.append(jnp.asarray(value, float), rest)


class _Path(eqx.Module):
    """The path constraint as a vector."""

    function: Any

    def __call__(self, t: RealScalarLike, y: Y, u: Float[Array, " m"]) -> Float[Array, " s"]:
        if self.function is None:
            return jnp.zeros(0, u.dtype)
        return jnp.atleast_1d(jnp.asarray(self.function(t, y, u), u.dtype))


def _solved(
    transcription: Transcription,
    u: np.ndarray,
    limits: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> OptimalTrajectory:
    T, v = transcription, np.zeros(transcription.size)
    bounds = np.tile([-np.inf, np.inf], (T.size, 1))
    v[T.inputs], bounds[T.inputs] = np.clip(u, *limits), limits.T
    check_guess(np.asarray(T.charts.ts), T.at(v))
    found = minimize(T, v, bounds, max_iterations, tolerance)
    T, v = found.transcription, np.clip(found.v, *bounds.T)
    measured = measure(T, v)
    message = message_of(found, measured)
    return OptimalTrajectory(
        ts=T.charts.ts,
        ys=jax.vmap(T.shooting.unravel)(jnp.asarray(T.at(v).knots.x)),
        inputs=jnp.asarray(T.at(v).u),
        cost=jnp.asarray(T.cost(v)),
        gap=jnp.asarray(measured.gap),
        integration_error=jnp.asarray(measured.error),
        success=jnp.asarray(not message),
        num_iterations=jnp.asarray(found.iterations),
        num_evaluations=jnp.asarray(T.evaluations),
        message=message,
    )
