"""What solvers share that know of mass matrices: what they refuse, and the check of the start."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.compat import is_sde, undirected
from .._base.types import BoolScalar, Y
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


def _check_terms(terms: Any) -> None:
    is_control = lambda x: isinstance(x, dfx.ControlTerm)
    leaves = jtu.tree_leaves(undirected(terms), is_leaf=is_control)
    if is_sde(terms) or any(is_control(leaf) for leaf in leaves):
        raise ValueError(
            "`terms` has noise or a control, which Rosenbrock and Radau methods are not for: they need a smooth field. "
            "Of a smooth control make an ODE, `diffrax.ControlTerm(f, control).to_ode()`."
        )
