"""What solvers share that know of mass matrices: what they refuse, the check of the start, and which steps are
to be repeated."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.compat import is_okay, is_sde, nonlinear_failure, undirected
from .._base.rejection import is_repeatable, rejecting
from .._base.types import BoolScalar, RealScalarLike, Y
from .._constraint.checks import check_state
from .._linalg.sparse import Choice
from .algebraic import is_consistent
from .system import System


class AbstractMassMatrixSolver(dfx.AbstractAdaptiveSolver):
    """A one-step method for an ODE or a [`MassMatrixTerm`][]."""

    checks_start: eqx.AbstractVar[bool]  # false if the state has been made consistent before

    def derivative_at_start(
        self, system: System, y0: Y, structure: Choice
    ) -> tuple[Float[Array, " n"] | None, BoolScalar]:
        """Return `y'` if the mass matrix depends on time or state, and whether the start is consistent.
        Refuse what cannot be solved."""
        check_state(y0)
        _check_terms(system.terms)
        if system.mass is None:
            return None, jnp.asarray(True)
        x, _ = jfu.ravel_pytree(y0)
        start, derivative = system.at_start(x, structure)
        usable = is_consistent(x, start) if self.checks_start else jnp.asarray(True)
        return derivative if callable(system.mass.mass) else None, usable


class AttemptedStep(NamedTuple):
    """The end of a step with its error estimate, whether the equations are defined where it begins, and
    whether they could be solved."""

    x1: Float[Array, " n"]
    error: Float[Array, " n"]
    defined: BoolScalar
    solved: BoolScalar

    def outcome(
        self, t0: RealScalarLike, t1: RealScalarLike, state: Any, unravel: Callable
    ) -> tuple[Y, Y, RESULTS]:
        """Return the state at the end, the error estimate, infinite if the step is to be repeated with a
        smaller one, and the result. `state` is that of the solver."""
        finite = jnp.all(jnp.isfinite(self.x1)) & jnp.all(jnp.isfinite(self.error))
        result = RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite)  # pyright: ignore[reportArgumentType]
        failed = self.defined & ~self.solved | ~state.usable
        result = RESULTS.where(failed, nonlinear_failure(), result)
        # A smaller step does not help if the equations are not defined at its beginning.
        repeatable = is_repeatable(t0, t1, state.first_step) & self.defined & state.usable
        y1 = unravel(self.x1 + jnp.where(state.usable, 0.0, jnp.nan).astype(self.x1.dtype))
        return y1, rejecting(unravel(self.error), is_okay(result), repeatable), result


def _check_terms(terms: Any) -> None:
    is_control = lambda x: isinstance(x, dfx.ControlTerm)
    leaves = jtu.tree_leaves(undirected(terms), is_leaf=is_control)
    if is_sde(terms) or any(is_control(leaf) for leaf in leaves):
        raise ValueError(
            "`terms` has noise or a control, which Rosenbrock and Radau methods are not for: they need a smooth field. "
            "Of a smooth control make an ODE, `diffrax.ControlTerm(f, control).to_ode()`."
        )
