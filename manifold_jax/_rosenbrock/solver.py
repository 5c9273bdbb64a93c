"""Rosenbrock methods as Diffrax solvers."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._compat import is_okay, is_sde, nonlinear_failure, time_direction
from .._constraint_checks import check_state
from .._custom_types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._rejection import is_repeatable, rejecting
from .algebraic import is_consistent
from .interpolation import RosenbrockInterpolation
from .stages import rosenbrock_step
from .system import mass_matrix_term, System
from .tableau import RODAS3P, RODAS5P, RosenbrockTableau


class RosenbrockState(eqx.Module):
    """Carried from step to step: the size of the first step that was tried (the scale of time near
    t = 0), `y'` where the mass matrix depends on the state, and whether the start can be used."""

    first_step: FloatScalar
    derivative: Float[Array, " n"] | None
    usable: BoolScalar


class AbstractRosenbrock(dfx.AbstractAdaptiveSolver):
    """Linearly implicit one-step methods: instead of equations to be iterated each stage has a
    linear system, all with the matrix `M / gamma - h df/dy`, which is factored once per step."""

    tableau: eqx.AbstractClassVar[RosenbrockTableau]
    checks_start: eqx.AbstractVar[bool]  # not where the state has been made consistent before

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., RosenbrockInterpolation]] = RosenbrockInterpolation

    def order(self, terms: Any) -> int:
        return self.tableau.order

    def func(self, terms: Any, t0: RealScalarLike, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def init(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> RosenbrockState:
        check_state(y0)
        _check_terms(terms)
        derivative, usable = None, jnp.asarray(True)
        term = mass_matrix_term(terms)
        if term is not None:
            direction = time_direction(terms)
            x, _ = jfu.ravel_pytree(y0)
            start = term.equations(y0, args).at(t0 * direction, x)
            if self.checks_start:
                usable = is_consistent(x, start)
            if callable(term.mass):
                derivative = start.derivative * jnp.asarray(direction, x.dtype)
        return RosenbrockState(jnp.abs(jnp.asarray(t1) - t0), derivative, usable)

    def step(
        self,
        terms: Any,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: RosenbrockState,
        made_jump: Any,
    ) -> tuple[Y, Y | None, dict[str, Any], RosenbrockState, RESULTS]:
        system = System.of(terms, t0, t1, y0, args)
        x0, unravel = jfu.ravel_pytree(y0)
        derivative = system.refreshed(made_jump, solver_state.derivative, x0)
        step = rosenbrock_step(self.tableau, system, x0, derivative)
        finite = jnp.all(jnp.isfinite(step.x1)) & jnp.all(jnp.isfinite(step.error))
        result = RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite)
        singular = step.defined & ~step.regular | ~solver_state.usable
        result = RESULTS.where(singular, nonlinear_failure(), result)
        # No smaller step helps where the equations are not defined at its beginning.
        repeatable = is_repeatable(t0, t1, solver_state.first_step)
        repeatable &= step.defined & solver_state.usable
        usable = jnp.where(solver_state.usable, 0.0, jnp.nan).astype(x0.dtype)
        y1 = unravel(step.x1 + usable)
        error = rejecting(unravel(step.error), is_okay(result), repeatable)
        dense_info = dict(y0=y0, y1=y1, k=tuple(unravel(k) for k in step.dense))
        state = RosenbrockState(solver_state.first_step, step.derivative, solver_state.usable)
        return y1, error, dense_info, state, result


class Rodas5P(AbstractRosenbrock):
    """Rosenbrock method of order 5 (embedded 4, dense output 4) with eight stages, for stiff
    equations and DAEs of index 1: L-stable and stiffly accurate."""

    tableau: ClassVar[RosenbrockTableau] = RODAS5P
    checks_start: bool = True


class Rodas3P(AbstractRosenbrock):
    """Rosenbrock method of order 3 (embedded 2, dense output 3)."""

    tableau: ClassVar[RosenbrockTableau] = RODAS3P
    checks_start: bool = True


def _check_terms(terms: Any) -> None:
    if is_sde(terms):
        raise ValueError("`terms` has noise, which Rosenbrock methods are not for.")
