"""Following a curve `H(x) = 0` by arclength, through its folds."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._adjoint import StepReplayAdjoint
from .._base.closure import convert_closure
from .._base.compat import nonlinear_failure
from .._base.errors import clear_errors
from .._base.numbers import by_precision, numbers_as_arrays
from .._base.types import Args, IntScalar, RealScalarLike
from .._constraint.checks import check_state
from .checks import as_curve_start, as_direction, check_counts, check_function, raise_if_failed
from .following import Curve, follow, start_on, unbroken
from .turning_points import find_turns


_MESSAGES = (
    "`function` is not finite at `x0`. Start from a point at which H(x0, args) is defined.",
    "`x0` is a singular point: the Jacobian DH does not have full rank there (branches cross, the curve ends, or an "
    "equation is redundant). Start elsewhere on the curve, or remove the dependent equation and a variable.",
    "`x0` is not near the curve: no point with H(x, args) = 0 was found from there. Start closer to it.",
    "`direction` does not say which way to go: it is perpendicular to the curve at `x0` (a number: the parameter has "
    "a turning point there). Pass a vector like `x0` that points along the curve.",
    "`length` must be positive and finite. To go the other way change the sign of `direction`.",
    "The curve meets a singular point (branches cross, or it has a cusp), or bends more sharply than `rtol` and "
    "`atol` resolve. With `throw=False` the points before it are returned; shorten `length`, or lower the tolerances.",
)


class CurveTrace(eqx.Module):
    """A piece of the curve `H(x) = 0` with `k = n + 1` unknowns, see [`trace_curve`][].

    - `arclengths`: `s_i`, equally spaced from 0 to `length`, shape `(points,)`.
    - `points`: `x(s_i)`, shape `(points, k)`, all on the curve to round-off. NaN from where
        a trace failed.
    - `tangents`: the unit tangents `dx/ds`, likewise.
    - `turning_points`: the points between the ends at which `dx[parameter]/ds` changes sign,
        in order, shape `(max_turning_points, k)`, to round-off; unused rows are NaN.
    - `turning_arclengths`: where they are, shape `(max_turning_points,)`, likewise.
    - `num_turning_points`: how many there are; more than `max_turning_points` if they did not all fit.
    - `result`: `RESULTS.successful`; `RESULTS.nonlinear_divergence` for an `x0` that cannot
        be used, a singular point, or a curve that ends; and the other codes of Diffrax.
    - `stats`: those of [`diffeqsolve`][]; `initial_correction` is how far `x0` was moved.
    """

    arclengths: Float[Array, " points"]
    points: Float[Array, "points k"]
    tangents: Float[Array, "points k"]
    turning_points: Float[Array, "turns k"]
    turning_arclengths: Float[Array, " turns"]
    num_turning_points: IntScalar
    result: RESULTS
    stats: dict[str, Any]


@clear_errors
@numbers_as_arrays("x0", "args")
@eqx.filter_jit
def trace_curve(
    function: Callable[[Float[Array, " k"], Args], Float[Array, " n"]],
    x0: Any,
    args: Args = None,
    *,
    length: RealScalarLike,
    points: int = 201,
    direction: Any = 1,
    solver: dfx.AbstractSolver | None = None,
    rtol: RealScalarLike | None = None,
    atol: RealScalarLike | None = None,
    max_steps: int = 4096,
    parameter: int = -1,
    max_turning_points: int = 16,
    adjoint: dfx.AbstractAdjoint | None = None,
    throw: bool = True,
) -> CurveTrace:
    """Follow the curve `H(x, args) = 0`, `n` equations in `n + 1` unknowns, by arclength.

    Solves `dx/ds = tau(x)`, `x(0) = x0` on the curve, where `DH tau = 0`, `|tau| = 1` and
    the sign of `det [DH; tau^T]` stays that at `x0`. Folds, where a parameter among
    the unknowns turns back, are points like any other. Closed curves go round again.

    **Arguments:**

    - `function`: `H(x, args)`, shape `(n,)`.
    - `x0`: a start near the curve, shape `(n + 1,)`; it is made consistent.
    - `args`: passed to `function`.
    - `length`: the arclength to go.
    - `points`: number of points returned, equally spaced, both ends included.
    - `direction`: a vector like `x0`, with a positive component along the curve; or 1 or -1
        for `x[parameter]` increasing or decreasing at first.
    - `solver`: a Runge-Kutta solver of Diffrax, by default `Tsit5()`.
    - `rtol`, `atol`: of the steps, by default 1e-8 (1e-5 in single precision). The points are on the
        curve to round-off anyway; this is the error of the arclength.
    - `max_steps`: the most steps.
    - `parameter`: the component whose turning points are reported.
    - `max_turning_points`: room for them.
    - `adjoint`: how to differentiate, by default in both modes by [`StepReplayAdjoint`][].
    - `throw`: raise where the trace fails. Otherwise look at `result`.

    **Returns:**

    A [`CurveTrace`][]. Points, tangents, turning points and their arclengths have exact
    first derivatives with respect to `x0`, `args`, and what `function` closes over.

    **Raises:**

    `TypeError` or `ValueError` for arguments that cannot work. With `throw=True` a `RuntimeError`
    if the start is not near the curve or singular, or if the trace meets a singular point. At every
    step the tangent must turn by less than 60 degrees and agree with the chord.

    Two things between steps (at most `length / 50` apart) go unnoticed: a pair of turning points,
    and a singular point at which the tangent hardly turns (branches that touch; or that cross at
    less than a degree, with tolerances above 1e-8). There is no branch switching; AUTO and
    BifurcationKit have it, and sparse matrices for more than about a hundred unknowns.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, section 2.2; Allgower
    & Georg, Numerical Continuation Methods, Springer 1990, chapters 2, 6 and 8.
    """
    x0 = as_curve_start(x0, parameter)
    check_state(x0, "x0")
    why = f"a curve has one unknown more than equations, and `x0` has {x0.size} numbers"
    check_function("function", function, (x0.size - 1,), why, x0, args)
    check_counts(2, points=points)
    check_counts(1, max_steps=max_steps, max_turning_points=max_turning_points)
    if isinstance(length, int | float) and not 0 < length < float("inf"):
        raise ValueError(f"{_MESSAGES[4]} Got {length}.")
    length = jnp.asarray(length, x0.dtype)

    curve = Curve(convert_closure(function, x0, args), args, jnp.ones((), x0.dtype))
    curve, start, info, faults = start_on(curve, x0, as_direction(direction, x0, parameter))
    positive = (length > 0) & jnp.isfinite(length)
    arclengths = jnp.linspace(0, jnp.where(positive, length, 1), points, dtype=x0.dtype)
    solver = dfx.Tsit5() if solver is None else solver
    adjoint = StepReplayAdjoint() if adjoint is None else adjoint
    default = x0.dtype, 1e-8, 1e-5
    tolerances = by_precision(rtol, *default), by_precision(atol, *default)
    # A straight piece has no error that limits the steps, and a step that leaps over two crossings
    # would notice neither.
    controller = dfx.PIDController(*tolerances, dtmax=arclengths[-1] / 50)
    options = dict(stepsize_controller=controller, max_steps=max_steps, adjoint=adjoint)
    sol, nodes = follow(curve, start, arclengths, solver, options)
    used, smooth = unbroken(nodes, *tolerances)
    usable = positive & ~jnp.any(faults)
    used = jnp.where(usable, used, 0)
    turns = find_turns(curve, sol.interpolation, nodes, used, parameter, max_turning_points)  # pyright: ignore[reportArgumentType]

    reached = smooth | (arclengths <= nodes.s[jnp.maximum(used - 1, 0)])
    valid = (usable & reached & jnp.isfinite(sol.ts[0]))[:, None]  # pyright: ignore[reportOptionalSubscript]
    # Replaced before the tangent is taken, as the derivative of a NaN is never zero.
    x = jnp.where(valid, sol.ys[0], start)  # pyright: ignore[reportOptionalSubscript]
    faults = jnp.concatenate([faults, jnp.stack([~positive, ~smooth])])
    trace = CurveTrace(
        arclengths,
        jnp.where(valid, x, jnp.nan),
        jnp.where(valid, jax.vmap(curve.tangent)(x), jnp.nan),
        jnp.where(turns.found[:, None], turns.x, jnp.nan),
        jnp.where(turns.found, turns.s, jnp.nan),
        turns.count,
        RESULTS.where(jnp.any(faults), nonlinear_failure(), sol.result),
        {**sol.stats, "initial_correction": info.correction},
    )
    return raise_if_failed(trace, faults, _MESSAGES) if throw else trace
