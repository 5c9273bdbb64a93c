"""Arguments of `mj.diffeqsolve` that cannot work, refused with what to write instead."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._compat import save_y
from .._custom_types import RealScalarLike, Y
from .._directed_term import DirectedTerm
from .._solver import Stabilized
from .._stability import is_stable, stability_interval
from .._user_function import check_function


# What Diffrax passes to an event function by name.
_EVENT_KEYWORDS = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller")
_EVENT_KEYWORDS += ("max_steps",)


def check_arguments(
    terms: Any,
    solver: Any,
    dt0: Any,
    saveat: Any,
    stepsize_controller: Any,
    adjoint: Any,
    event: Any,
    consistent: str,
) -> None:
    if isinstance(terms, dfx.AbstractSolver):
        raise TypeError(
            f"`terms` is a {type(terms).__name__}, a solver: the terms come first, `mj.diffeqsolve(terms, solver, t0, "
            "t1, dt0, y0)`."
        )
    _check_terms(terms)
    _check_kind("solver", solver, dfx.AbstractSolver, "mj.Projected(diffrax.Tsit5(), constraint)")
    _check_kind("saveat", saveat, dfx.SaveAt, "diffrax.SaveAt(ts=...)")
    _check_kind(
        "stepsize_controller",
        stepsize_controller,
        dfx.AbstractStepSizeController,
        "diffrax.PIDController(rtol=1e-6, atol=1e-6)",
    )
    _check_kind("adjoint", adjoint, dfx.AbstractAdjoint, "mj.StepReplayAdjoint()")
    if event is not None:
        _check_kind("event", event, dfx.Event, "diffrax.Event(cond_fn)")
        for cond_fn in jtu.tree_leaves(event.cond_fn, is_leaf=callable):
            call = "cond_fn(t, y, args, **kwargs)"
            check_function("event", cond_fn, call, *_EVENT_KEYWORDS)
    for sub in jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt)):
        if sub.fn is not save_y:
            check_function("saveat.fn", sub.fn, "fn(t, y, args)")
    if dt0 is None and isinstance(stepsize_controller, dfx.ConstantStepSize):
        raise ValueError(
            "`dt0` is None, but the size of the steps is constant: give it, or let "
            "`stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6)` choose."
        )
    _check_choices(adjoint, consistent)


def _check_choices(adjoint: Any, consistent: str) -> None:
    if isinstance(adjoint, dfx.ImplicitAdjoint):
        raise ValueError(
            "`adjoint=ImplicitAdjoint()` inverts df/dy, which is singular on a manifold: it says nothing of the "
            "directions across. Leave `adjoint` out (`mj.StepReplayAdjoint()`), or for the minimum of a function "
            "`mj.gradient_flow`."
        )
    if isinstance(adjoint, dfx.BacksolveAdjoint):
        raise ValueError(
            "`adjoint=BacksolveAdjoint()` loses the gradient through the corrections (it would be silently wrong). "
            "Leave `adjoint` out (`mj.StepReplayAdjoint()`), or use `diffrax.ForwardMode()`."
        )
    if consistent not in ("project", "check", "assume"):
        raise ValueError(
            f"`consistent` must be 'project', 'check' or 'assume', got {consistent!r}."
        )


def _check_terms(terms: Any) -> None:
    if isinstance(getattr(terms, "terms", None), dfx.AbstractTerm):
        raise TypeError(
            f"`terms` is an `mj.{type(terms).__name__}`: pass its vector field, `system.terms`."
        )
    is_term = lambda x: isinstance(x, dfx.AbstractTerm)
    leaves = jtu.tree_leaves(terms, is_leaf=is_term)
    for leaf in leaves:
        _check_kind("terms", leaf, dfx.AbstractTerm, "diffrax.ODETerm(lambda t, y, args: ...)")
        if isinstance(leaf, dfx.ODETerm | dfx.ControlTerm):
            check_function("terms", leaf.vector_field, "f(t, y, args)")
    if not leaves:
        raise TypeError("`terms` is empty. Write e.g. `diffrax.ODETerm(lambda t, y, args: ...)`.")


def _check_kind(name: str, value: Any, kind: type, example: str) -> None:
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(f"`{name}` must be an instance, got the class {value.__name__}: call it.")
    if not isinstance(value, kind):
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise TypeError(
            f"`{name}` must be a `diffrax.{kind.__name__}`, got {got}. Write e.g. `{example}`."
        )


def raise_if_unstable(y0: Y, terms: Any, solver: dfx.AbstractSolver, dt0: RealScalarLike) -> Y:
    """Refuse constant steps with which stabilization makes violations grow."""
    stabilized = isinstance(solver, Stabilized)
    if not stabilized and not isinstance(terms, DirectedTerm):
        return y0
    gain = solver.stabilization.rate if stabilized else terms.rate
    inner = solver.solver if isinstance(solver, dfx.AbstractWrappedSolver) else solver
    interval = stability_interval(inner)
    y0 = jtu.tree_map(jnp.asarray, y0)
    message = (
        f"`stabilization` has a gain with which gain * dt0 is beyond the stability interval {interval:.2f} of "
        f"{type(inner).__name__}: violations would grow. Use a smaller gain or `dt0`, or an adaptive step size "
        "controller."
    )
    return eqx.error_if(y0, ~is_stable(gain, dt0, inner), message)
