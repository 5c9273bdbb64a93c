"""Constrained minimization by following the projected gradient."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array, Bool, Float

from .._base.closure import convert_closure
from .._base.compat import is_okay, nonlinear_failure
from .._base.errors import clear_errors
from .._base.numbers import by_precision, numbers_as_arrays
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._constraint.checks import check_constraint, check_constraint_type, check_state
from .._constraint.constraint import AbstractConstraint, Constraint
from .._constraint.residual import residual_vector, row_scale
from .._constraint.settings import NewtonProjection
from .._linalg.newton import without_derivative
from .._solve import diffeqsolve
from .._solver import Projected
from .checks import check_function, raise_if_failed
from .stationary import Lagrangian, stationary_point


_MESSAGES = (
    "`constraint` is not finite at `x0`. Start from a point at which g(0, x0, args) is defined.",
    "`objective` or its gradient is not finite at `x0`. Start from a point at which both are defined.",
    "The Jacobian dg/dx of `constraint` does not have full rank at `x0`: an equation ignores x, depends on the "
    "others (redundant), or `x0` is a singular point. Remove dependent equations, or start elsewhere.",
    "`x0` does not satisfy `constraint`. Move it there first: "
    "`x0, _ = mj.consistent_state(constraint, 0.0, x0, args)`.",
    "`t1` came before the projected gradient was below `tolerance`. Increase `t1` (the flow needs about "
    "20 / curvature at the minimum) or scale `objective`; a function without a minimum is never done.",
)


class ConstrainedMinimum(eqx.Module):
    """The end of a [`gradient_flow`][], and whether it is a minimum.

    With `G = dg/dx` and the Lagrangian `L(x, lambda) = f(x) + lambda . g(x)`:

    - `x`: the point, like `x0`. After a failure the last one that was reached.
    - `multipliers`: `lambda`, shape `(m,)`, with the sign of `grad f + G^T lambda = 0`.
        (The least value of `f` subject to `g = c` changes by `-lambda . dc`.)
    - `objective`: `f(x)`.
    - `violation`: `max_i |g_i|`, not scaled.
    - `stationarity`: `max_j |(grad f + G^T lambda)_j|`, not scaled.
    - `curvature`: the smallest eigenvalue of the Hessian of `L` on the tangent space
        `G v = 0`. Positive certifies a strict local minimum, negative a saddle point or
        a maximum, zero nothing. `inf` if there is no direction left (`m = n`).
    - `is_minimum`: whether the flow succeeded and the curvature is positive, beyond rounding
        errors and in the neighbourhood to which the point is known. Look at this: a flow
        that starts at a saddle point or a maximum stays there.
    - `flow_time`: the `t` at which the flow ended.
    - `result`: `RESULTS.successful` for a stationary point of whatever kind;
        `RESULTS.nonlinear_max_steps_reached` if `t1` came first;
        `RESULTS.nonlinear_divergence` for an `x0` that cannot be used or a constraint that
        could not be satisfied on the way; and the other codes of Diffrax.
    - `stats`: as those of [`diffeqsolve`][].
    """

    x: Y
    multipliers: Float[Array, " m"]
    objective: FloatScalar
    violation: FloatScalar
    stationarity: FloatScalar
    curvature: FloatScalar
    is_minimum: BoolScalar
    flow_time: FloatScalar
    result: RESULTS
    stats: dict[str, Any]


@clear_errors
@numbers_as_arrays("x0", "args", times=("t1",))
@eqx.filter_jit
def gradient_flow(
    objective: Callable[[Y, Args], FloatScalar],
    constraint: AbstractConstraint,
    x0: Y,
    args: Args = None,
    *,
    t1: RealScalarLike = 1e6,
    solver: dfx.AbstractSolver | None = None,
    rtol: RealScalarLike | None = None,
    atol: RealScalarLike | None = None,
    tolerance: float | None = None,
    max_steps: int | None = 4096,
    throw: bool = True,
) -> ConstrainedMinimum:
    """Minimize `f(x, args)` subject to `g(x, args) = 0` by following the projected gradient,

    `x' = -P(x) grad f(x)`,  `P = I - G^T (G G^T)^-1 G`,  `G = dg/dx`,

    on the manifold from `x0` to a stationary point, then by Newton's method on
    `grad f + G^T lambda = 0`, `g = 0` to round-off. `f` never increases on the way and every point is
    feasible, so that (up to the error of the steps) the minimum is the one whose basin `x0` is in.

    The derivative with respect to `args`, and to everything that `objective` and `constraint` hold
    or close over, is that of the stationary point itself (implicit function), exact in forward and
    reverse mode and to any order. It is zero with respect to `x0`.

    **Arguments:**

    - `objective`: `f(x, args)`, one number.
    - `constraint`: an [`mj.Constraint`][], `g(t, x, args)`; evaluated at `t = 0`. Its equations must be
        independent: `redundant=True` is refused.
    - `x0`: a point that satisfies the constraint, any pytree of real arrays.
    - `args`: passed to both.
    - `t1`: the time after which to give up. Time is in units of 1 / curvature of `f`.
    - `solver`: a Diffrax solver, by default `Kvaerno3()`. The flow is stiff near a minimum:
        an explicit method takes about as many steps as the curvatures differ by, and its
        errors of size `rtol` keep the gradient from falling below `tolerance`.
    - `rtol`, `atol`: the tolerances of the steps, by default 1e-6 (1e-4 in single precision). They
        decide which basin is reached from a start near its edge, not the accuracy of the result.
    - `tolerance`: the flow ends where `max_j |P grad f| <= tolerance max_j |grad f|`, with
        `grad f` there or at `x0`, whichever is larger; by default 1e-8 (1e-5 in single
        precision). Newton's method may then move the point by at most `sqrt(tolerance) (|x| + 1)`,
        otherwise it is left where it is.
    - `max_steps`: the most steps of the flow.
    - `throw`: raise if no stationary point is found. Otherwise look at `result`.

    **Returns:**

    A [`ConstrainedMinimum`][]. Check `is_minimum`.

    **Raises:**

    `TypeError` or `ValueError` for arguments that cannot work. With `throw=True` a
    `RuntimeError` if `x0` is not feasible or a singular point of the constraint, if `t1`
    comes first, or if the flow fails.

    Prefer `optimistix` or SciPy for problems without constraints or with inequalities, and
    a quasi-Newton method (SciPy's SLSQP, IPOPT) where many variables (thousands) make
    Hessians too large; they may end in another basin, and are not differentiable.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, section 2.2 (d); Tanabe, J.
    Optim. Theory Appl. 30 (1980) 333-359; Yamashita, Math. Program. 18 (1980) 155-168.
    """
    check_constraint_type(constraint, "gradient_flow(objective, constraint, x0, args)")
    check_state(x0, "x0")
    x0 = jtu.tree_map(jnp.asarray, x0)
    check_constraint(constraint, 0.0, x0, args)
    if constraint.redundant:
        raise ValueError(
            "`constraint` has `redundant=True`, but multipliers are unique only for independent equations. Leave out those "
            "that follow from others, and `redundant`."
        )
    check_function("objective", objective, (), "e.g. `jnp.sum(...)`", x0, args)
    start, unravel = jfu.ravel_pytree(x0)
    tolerance = by_precision(tolerance, start.dtype, 1e-8, 1e-5)
    if not 0 < tolerance < 1:
        raise ValueError(f"`tolerance` must be between 0 and 1, got {tolerance}.")
    lagrangian = Lagrangian(
        convert_closure(lambda x, args: objective(unravel(x), args), start, args),
        convert_closure(
            lambda x, args: residual_vector(constraint, 0.0, unravel(x), args), start, args
        ),
        args,
    )
    fixed, start = without_derivative((lagrangian, start))
    faults = _start_faults(fixed, start)
    solver = dfx.Kvaerno3() if solver is None else solver
    default = start.dtype, 1e-6, 1e-4
    tolerances = by_precision(rtol, *default), by_precision(atol, *default)
    options = dict(stepsize_controller=dfx.PIDController(*tolerances), max_steps=max_steps)
    sol, size = _descend(fixed, start, t1, solver, tolerance, options)

    usable = ~jnp.any(faults)
    arrived = sol.result == RESULTS.event_occurred
    unfinished = sol.result == RESULTS.successful
    result = RESULTS.where(arrived, RESULTS.successful, sol.result)
    result = RESULTS.where(unfinished, RESULTS.nonlinear_max_steps_reached, result)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(usable, result, nonlinear_failure())
    reach = jnp.where(usable & arrived, tolerance**0.5, 0.0)
    minimum = _describe(lagrangian, sol, start, unravel, reach, size, result)
    faults = jnp.append(faults, unfinished)
    return raise_if_failed(minimum, faults, _MESSAGES) if throw else minimum


def _start_faults(lagrangian: Lagrangian, start: Float[Array, " n"]) -> Bool[Array, " 4"]:
    """Return which of `_MESSAGES` apply to the start."""
    G, factorization = lagrangian.normals(start)
    level = jnp.max(jnp.abs(lagrangian.g(start)) / row_scale(G, start))
    value, slope = jax.value_and_grad(lagrangian.f)(start)
    return jnp.stack(
        [
            ~(jnp.isfinite(level) & jnp.all(jnp.isfinite(G))),
            ~(jnp.isfinite(value) & jnp.all(jnp.isfinite(slope))),
            ~factorization.usable,
            level > NewtonProjection().tolerance_for(start.dtype),
        ]
    )


def _descend(
    lagrangian: Lagrangian,
    start: Float[Array, " n"],
    t1: RealScalarLike,
    solver: dfx.AbstractSolver,
    tolerance: float,
    options: dict[str, Any],
) -> tuple[dfx.Solution, FloatScalar]:
    """Follow the projected gradient; return the typical size of the gradient, too."""
    largest = lambda v: jnp.max(jnp.abs(v))
    # If `grad f` is (nearly) zero at the start, only its rounding errors would be left as the scale.
    bend = jnp.max(jnp.sum(jnp.abs(jax.hessian(lagrangian.f)(start)), axis=1))
    rounding = 10 * jnp.finfo(start.dtype).eps * bend * (largest(start) + 1)
    size = jnp.maximum(largest(jax.grad(lagrangian.f)(start)), rounding / tolerance)

    def stationary(t, x, args, **kwargs):
        slope, _ = lagrangian.projected_gradient(x)
        return largest(slope) <= tolerance * jnp.maximum(size, largest(jax.grad(lagrangian.f)(x)))

    term = dfx.ODETerm(lambda t, x, args: -lagrangian.projected_gradient(x)[0])
    hook = Projected(solver, Constraint(lambda t, x, args: lagrangian.g(x)))
    sol = diffeqsolve(
        *(term, hook, jnp.zeros((), start.dtype), jnp.asarray(t1, start.dtype), None, start),
        adjoint=dfx.ForwardMode(),  # nothing is differentiated through the flow
        event=dfx.Event(stationary),
        throw=False,
        consistent="assume",
        **options,
    )
    return sol, jnp.maximum(size, jnp.finfo(start.dtype).tiny)


def _describe(
    lagrangian: Lagrangian,
    sol: dfx.Solution,
    start: Float[Array, " n"],
    unravel: Callable,
    reach: FloatScalar,
    size: FloatScalar,
    result: RESULTS,
) -> ConstrainedMinimum:
    reached = sol.ys[-1]  # pyright: ignore[reportOptionalSubscript]
    reached = jnp.where(jnp.all(jnp.isfinite(reached)), reached, start)
    x, multipliers, curvature, is_minimum = stationary_point(lagrangian, reached, reach, size)
    return ConstrainedMinimum(
        x=unravel(x),
        multipliers=multipliers,
        objective=lagrangian.f(x),
        violation=jnp.max(jnp.abs(lagrangian.g(x))),
        stationarity=jnp.max(jnp.abs(jax.grad(lagrangian)(x, multipliers))),
        curvature=curvature,
        is_minimum=is_okay(result) & is_minimum,
        flow_time=sol.ts[-1],  # pyright: ignore[reportOptionalSubscript]
        result=result,
        stats=sol.stats,
    )
