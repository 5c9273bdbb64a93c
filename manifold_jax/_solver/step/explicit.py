"""One explicit Runge-Kutta step, written out stage by stage or in a loop over the stages.

Diffrax runs the stages in a loop with dynamic buffers. Writing them out lets XLA fuse a whole step of a
small system, and lets the new state be corrected *before* the last stage is evaluated there, so that
the derivative that a first-same-as-last method carries over belongs to the corrected state at no cost.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from diffrax import AbstractTerm
from jaxtyping import Array

from ..._base.types import Args, RealScalarLike, Y
from ..._constraint.projection_info import ProjectionInfo
from ..._jaxpr.trace import num_equations
from .frame import StepFrame


# Largest number of equations of the vector field times stages for which stages are written out. With up
# to 210 (rigid body) a loop over the stages takes 1.1 to 1.3 times as long, and 1.7 to 2.7 times in a
# batch; from 1278 (double pendulum) 0.65 to 0.9 times, and 1830 equations (slider-crank) compile in 0.8
# of the time. jaxlib 0.10.2 and 0.12.0.1, `python -m benchmarks.speed.thresholds`.
LARGEST_UNROLLED = 500


def is_unrollable(solver: dfx.AbstractSolver, terms: Any, t0, t1, y0: Y, args: Args) -> bool:
    """Whether the solver has an explicit method with one tableau and the step of Diffrax, not of a
    subclass, and the vector field can be evaluated on its own."""
    return (
        isinstance(solver, dfx.AbstractERK)
        and not isinstance(solver, dfx.AbstractWrappedSolver)  # answers for its inner solver
        and isinstance(solver.tableau, dfx.ButcherTableau)
        and all(_is_inherited(type(solver), name) for name in ("init", "step", "func"))
        and not terms.is_vf_expensive(t0, t1, y0, args)
    )


def _is_inherited(solver: type, name: str) -> bool:
    return getattr(solver, name) is getattr(dfx.AbstractRungeKutta, name)


def is_first_same_as_last(tableau: dfx.ButcherTableau) -> bool:
    return tableau.fsal and tableau.ssal


class ExplicitStepResult(NamedTuple):
    """The state at the end, the coordinates there and their embedded error estimate, the data of the
    solver's own interpolation, the vector field of the last stage, and the report of the correction."""

    y1: Y
    w1: Y
    error: Y
    dense_info: dict[str, Any]
    f1: Any
    info: ProjectionInfo


def explicit_step(
    tableau: dfx.ButcherTableau,
    terms: AbstractTerm,
    frame: StepFrame,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    f0: Any,
    in_a_loop: bool | None = None,
) -> ExplicitStepResult:
    """Step from `y0`, with `f0` the vector field there (None: evaluated here), and correct the result.

    `frame.terms` are evaluated at the stages, `terms` at states on the manifold. By default stages are
    evaluated in a loop if that is faster.
    """
    control = terms.contr(t0, t1)
    # Traced once, not once per stage.
    at_corrected = jax.jit(lambda t, y: terms.vf(t, y, args))
    at_stage = jax.jit(lambda t, w: frame.terms.vf(t, w, args))
    if frame.terms is terms:
        at_stage = at_corrected
    fsal = is_first_same_as_last(tableau)
    rows, w0 = list(tableau.a_lower), frame.origin
    # Not rounded beyond `t1`, where the field may jump.
    times = [jnp.asarray(t1 if c == 1 else t0 + float(c) * (t1 - t0)) for c in tableau.c]
    inner = (rows[:-1], times[:-1]) if fsal else (rows, times)
    increment = lambda t, w: frame.terms.prod(at_stage(t, w), control)

    def first_increment() -> Y:
        field = at_corrected(jnp.asarray(t0), y0) if f0 is None else f0
        return frame.pull_back(t0, w0, y0, terms.prod(field, control))

    first = None if f0 is None and frame.terms is terms else first_increment()
    if in_a_loop is None:
        length = num_equations(at_stage, jnp.asarray(t0), w0)
        in_a_loop = length * (len(inner[0]) + 1) > LARGEST_UNROLLED and bool(inner[0])
    if in_a_loop:
        increments = _stages_in_a_loop(*inner, increment, w0, first, jnp.asarray(t0))
    else:
        increments = _stages(*inner, increment, w0, first_increment() if first is None else first)
    # The last stage of a first-same-as-last method is evaluated at the corrected state.
    w1 = derivative_once(_combine(rows[-1] if fsal else tableau.b_sol, increments, w0), w0)
    y1, info = frame.correct(w1)
    f1 = None
    if fsal:
        # A failed step may end in NaN, whose derivative would be NaN instead of zero.
        safe = lambda a, b: jnp.where(info.success, a, jax.lax.stop_gradient(b))
        end, at_end = jnp.asarray(t1), jtu.tree_map(safe, y1, y0)
        f1 = at_corrected(end, at_end)
        increments.append(frame.pull_back(end, w1, at_end, terms.prod(f1, control)))
    error = _combine(tableau.b_error, increments)
    k = jtu.tree_map(lambda *ks: jnp.stack(ks), *increments)
    return ExplicitStepResult(y1, w1, error, dict(y0=w0, y1=w1, k=k), f1, info)


def _stages(rows: list[Any], times: list[Array], increment: Callable, w0: Y, first: Y) -> list[Y]:
    increments = [first]
    for row, t in zip(rows, times, strict=True):
        increments.append(increment(t, derivative_once(_combine(row, increments, w0), w0)))
    return increments


def _stages_in_a_loop(
    rows: list[Any], times: list[Array], increment: Callable, w0: Y, first: Y | None, t0: Array
) -> list[Y]:
    """Compute the same with the vector field compiled once, whatever the number of stages. The first
    increment is computed in the loop, too, unless it is known."""
    count = len(rows) + 1
    padded = [np.pad(np.asarray(row, np.float64), (0, count - len(row))) for row in ([], *rows)]
    empty = lambda k: jnp.zeros((count, *k.shape), k.dtype)
    buffer, begin = jtu.tree_map(empty, w0 if first is None else first), 0
    if first is not None:
        buffer, begin = jtu.tree_map(lambda b, k: b.at[0].set(k), buffer, first), 1

    def stage(buffer: Y, xs: Any) -> tuple[Y, None]:
        i, t, row = xs
        sum_up = lambda k, w: w + jnp.tensordot(row.astype(k.dtype), k, axes=1)
        new = increment(t, jtu.tree_map(sum_up, buffer, w0))
        return jtu.tree_map(lambda k, n: k.at[i].set(n), buffer, new), None

    at, weights = jnp.stack([t0, *times]), jnp.asarray(np.stack(padded))
    xs = jnp.arange(begin, count), at[begin:], weights[begin:]
    buffer, _ = jax.lax.scan(stage, buffer, xs)
    take = lambda i: jtu.tree_map(lambda k: k[i], buffer)
    return [take(i) for i in range(count)]


@jax.custom_jvp
def derivative_once(y: Y, like: Y) -> Y:
    """Return `y`, with a derivative that is computed once. `like` is any known state.

    XLA for CPUs copies sums and products into every kernel that needs them, here the chain of all
    stages into the derivative of each, but never a division. The derivative is therefore divided by a
    one that XLA does not recognize. Without this, gradients take 1.1 (jaxlib 0.10.2) and 1.3 times
    (0.12.0.1) as long in a batch: `python -m benchmarks.speed.thresholds`.
    """
    del like
    return y


@derivative_once.defjvp
def _derivative(primals: tuple[Y, Y], tangents: tuple[Y, Y]) -> tuple[Y, Y]:
    (y, like), (y_dot, _) = primals, tangents
    like = jax.lax.stop_gradient(like)
    one = jtu.tree_map(lambda x: jnp.where(x == x, jnp.ones_like(x), x), like)
    return y, jtu.tree_map(jnp.divide, y_dot, one)


def _combine(weights: Any, increments: list[Y], start: Y | None = None) -> Y:
    """Return `start + sum_i weights_i increments_i`, without the terms whose weight is zero."""
    used = [(float(w), k) for w, k in zip(weights, increments, strict=True) if w != 0]
    used = used or [(0.0, increments[0])]
    total = jtu.tree_map(
        lambda *ks: sum(w * k for (w, _), k in zip(used, ks, strict=True)), *(k for _, k in used)
    )
    return total if start is None else jtu.tree_map(jnp.add, start, total)


def refreshed(made_jump: Any, f0: Any, evaluate: Callable[[], Any]) -> Any:
    """Return the carried derivative, evaluated again after a jump of the vector field."""
    if made_jump is False:
        return f0
    return jax.lax.cond(made_jump, evaluate, lambda: f0)
