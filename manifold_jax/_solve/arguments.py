"""Checks of the arguments of `mj.diffeqsolve`; messages say what to write instead."""

import math
import warnings
from typing import Any, cast

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._adjoint.events import EVENT_KEYWORDS
from .._base.compat import save_y
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.checks import check_field_is_real, has_no_equations
from .._solver import Stabilized
from .._solver.base import AbstractManifoldSolver, controller_tolerances
from .._solver.stabilization import is_stable, stability_interval
from .._solver.terms import DirectedTerm


_OWN_FIELDS = ("manifold_jax._mechanics", "manifold_jax._dae")


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
            check_function("event", cond_fn, call, *EVENT_KEYWORDS)
    for sub in jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt)):
        if sub.fn is not save_y:
            check_function("saveat.fn", sub.fn, "fn(t, y, args)")
        if sub.ts is not None and np.ndim(sub.ts) != 1:
            raise ValueError(
                f"`saveat.ts` must be a vector of times, got shape {np.shape(sub.ts)}."
            )
    if dt0 is None and isinstance(stepsize_controller, dfx.ConstantStepSize):
        raise ValueError(
            "`dt0` is None, but the size of the steps is constant: give it, or let "
            "`stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6)` choose."
        )
    _check_choices(adjoint, consistent)


def check_max_steps(max_steps: Any) -> None:
    if max_steps is None or (isinstance(max_steps, int) and max_steps > 0):
        return
    raise ValueError(
        f"`max_steps` must be a positive integer, or None for no bound, got {max_steps!r}."
    )


def check_field(terms: Any, t0: Any, y0: Any, args: Any) -> None:
    """Refuse a vector field of another shape than the state, which might be broadcast, and a complex one of
    a real state. Those of mechanical systems and reduced DAEs have its shape, and take long to trace."""
    module = getattr(getattr(terms, "vector_field", None), "__module__", None) or ""
    if not isinstance(terms, dfx.ODETerm) or module.startswith(_OWN_FIELDS):
        return
    try:
        field = eqx.filter_eval_shape(terms.vector_field, t0, y0, args)
    except Exception:  # raised again, with its place, where the solve evaluates it
        return
    shapes = [[jnp.shape(leaf) for leaf in jtu.tree_leaves(tree)] for tree in (field, y0)]
    if jtu.tree_structure(field) != jtu.tree_structure(y0):
        return  # Diffrax reports other structures
    if shapes[0] == shapes[1]:
        return check_field_is_real(field, y0)
    got, state = (jtu.tree_map(jnp.shape, tree) for tree in (field, y0))
    raise ValueError(
        f"The vector field in `terms` must be like the state, of shape {state}, but returns {got}: one velocity for "
        "every number of `y`."
    )


def check_shape_of_tolerances(controller: Any, y0: Y) -> None:
    """Refuse tolerances of other shapes than numbers of the state."""
    tolerances = controller_tolerances(controller)
    if tolerances is None:
        return
    for name in ("rtol", "atol"):
        shape = jnp.shape(getattr(tolerances, name))
        if math.prod(shape) == 1:
            continue
        for leaf in map(jnp.shape, jtu.tree_leaves(y0)):
            if len(shape) > len(leaf) or any(
                a not in (1, b) for a, b in zip(shape[::-1], leaf[::-1], strict=False)
            ):
                raise ValueError(
                    f"`{name}` of `stepsize_controller` must be a number, or an array with one for every number of the "
                    f"state, of shape {leaf}, got shape {shape}."
                )


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


def without_idle_hook(solver: Any, t0: RealScalarLike, y0: Y, args: Args) -> Any:
    """Return the inner solver if its hook has no equations, as reduced or generated systems may have."""
    if not isinstance(solver, AbstractManifoldSolver):
        return solver
    return solver.inner if has_no_equations(solver.constraint, t0, y0, args) else solver


def with_positive_tolerance(controller: Any, y0: Y) -> Any:
    """Return the controller with an `atol` of at least the smallest number. With none the error of a component
    that is zero and stays so would be `0 / 0`, and no step would ever be accepted."""
    tolerances = controller_tolerances(controller)
    if tolerances is None:
        return controller
    with jax.numpy_dtype_promotion("standard"):
        dtypes = [jnp.result_type(float, leaf) for leaf in jtu.tree_leaves(y0)]
    smallest = max((float(jnp.finfo(dtype).tiny) for dtype in dtypes), default=0.0)
    atol = tolerances.atol
    if isinstance(atol, int | float):
        if atol >= smallest:
            return controller
        atol = smallest
    else:
        atol = jnp.maximum(jnp.asarray(atol, jnp.result_type(float)), smallest)
    found = lambda controller: cast(Any, controller_tolerances(controller)).atol
    return eqx.tree_at(found, controller, atol)


def warn_of_rounding(y0: Y, time: Any, controller: Any) -> None:
    """Warn of tolerances, if known, that are below the resolution of 32-bit numbers."""
    tolerances = controller_tolerances(controller)
    if tolerances is None or not all(
        isinstance(x, int | float) for x in (tolerances.rtol, tolerances.atol)
    ):
        return
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(time, *jtu.tree_leaves(y0))
    largest = max(tolerances.rtol, tolerances.atol)
    if jnp.issubdtype(dtype, jnp.floating) and largest < 5 * jnp.finfo(dtype).eps:
        warnings.warn(
            f"`rtol` and `atol` of `stepsize_controller` are at most {largest:g}, below the rounding of {dtype} numbers, "
            f"{jnp.finfo(dtype).eps:.0e}: steps become tiny and gain nothing. Use tolerances from "
            f'{10 * jnp.finfo(dtype).eps:.0e} on, or 64 bits (`jax.config.update("jax_enable_x64", True)`).',
            stacklevel=2,
        )


def warn_of_unknown_hook(solver: dfx.AbstractSolver) -> None:
    if isinstance(solver, dfx.HalfSolver) or not isinstance(solver, dfx.AbstractWrappedSolver):
        return
    name = type(solver).__name__
    warnings.warn(
        f"`solver` is a {name}, a wrapper of your own: `mj.diffeqsolve` does not know its constraint, and corrects "
        "neither `y0` nor values between steps (`SaveAt(ts=)`, events, the dense solution). Write "
        f"`mj.Projected({name}(...), constraint)`, derive it from `mj.AbstractManifoldSolver`, or call "
        "`diffrax.diffeqsolve`.",
        stacklevel=2,
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
