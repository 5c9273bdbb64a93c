"""One explicit Runge-Kutta step, written out stage by stage.

Diffrax runs the stages in a loop with dynamic buffers. Writing them out lets XLA fuse a
whole step of a small system, and lets the new state be corrected *before* the last stage
is evaluated there, so that the derivative that a first-same-as-last method carries over
belongs to the corrected state at no cost.
"""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import AbstractTerm

from .._custom_types import Args, RealScalarLike, Y
from .._projection import ProjectionInfo


def is_unrollable(solver: dfx.AbstractSolver, terms: Any, t0, t1, y0: Y, args: Args) -> bool:
    """Explicit, one tableau, and a vector field that may be evaluated on its own."""
    return (
        isinstance(solver, dfx.AbstractERK)
        and not isinstance(solver, dfx.AbstractWrappedSolver)  # which answers for its inner solver
        and isinstance(solver.tableau, dfx.ButcherTableau)
        and not terms.is_vf_expensive(t0, t1, y0, args)
    )


def is_first_same_as_last(tableau: dfx.ButcherTableau) -> bool:
    return tableau.fsal and tableau.ssal


def explicit_step(
    tableau: dfx.ButcherTableau,
    terms: AbstractTerm,
    stage_terms: AbstractTerm,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    f0: Any,
    correct: Callable[[Y], tuple[Y, ProjectionInfo]],
) -> tuple[Y, Y, Y, dict[str, Any], Any, ProjectionInfo]:
    """Step from `y0`, with `f0` the vector field there, and correct the result.

    `stage_terms` are evaluated at the stages, `terms` at corrected states.

    **Returns:**

    The corrected state, the uncorrected one, the embedded error estimate, the data of the
    solver's own interpolation, the vector field of the last stage, and what `correct`
    returned besides the state.
    """
    control = terms.contr(t0, t1)
    # Traced once, not once per stage.
    at_corrected = jax.jit(lambda t, y: terms.vf(t, y, args))
    at_stage = jax.jit(lambda t, y: stage_terms.vf(t, y, args))
    if stage_terms is terms:
        at_stage = at_corrected
    fsal = is_first_same_as_last(tableau)
    rows, nodes = list(tableau.a_lower), [float(c) for c in tableau.c]
    f, increments = f0, [terms.prod(f0, control)]
    for row, c in zip(rows[:-1] if fsal else rows, nodes, strict=False):
        y = _combine(row, increments, y0)
        f = at_stage(jnp.asarray(t0 + c * (t1 - t0)), y)
        increments.append(terms.prod(f, control))
    # The last stage of a first-same-as-last method is taken at the new state itself.
    raw = _combine(rows[-1] if fsal else tableau.b_sol, increments, y0)
    y1, info = correct(raw)
    if fsal:
        # A failed step may end in NaN, of which the derivative would be NaN, not zero.
        safe = lambda a, b: jnp.where(info.success, a, jax.lax.stop_gradient(b))
        f = at_corrected(jnp.asarray(t1), jtu.tree_map(safe, y1, y0))
        increments.append(terms.prod(f, control))
    error = _combine(tableau.b_error, increments)
    k = jtu.tree_map(lambda *ks: jnp.stack(ks), *increments)
    return y1, raw, error, dict(y0=y0, y1=raw, k=k), f, info


def _combine(weights: Any, increments: list[Y], start: Y | None = None) -> Y:
    """`start + sum_i weights_i increments_i`, without the terms whose weight is zero."""
    used = [(float(w), k) for w, k in zip(weights, increments, strict=True) if w != 0]
    total = jtu.tree_map(
        lambda *ks: sum(w * k for (w, _), k in zip(used, ks, strict=True)), *(k for _, k in used)
    )
    return total if start is None else jtu.tree_map(jnp.add, start, total)


def refreshed(made_jump: Any, f0: Any, evaluate: Callable[[], Any]) -> Any:
    """The carried derivative, evaluated anew after a jump of the vector field."""
    if made_jump is False:
        return f0
    return jax.lax.cond(made_jump, evaluate, lambda: f0)
