"""The equations that are solved for the leading derivatives."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.newton import AbstractEquations, implicit_root, without_derivative
from .compressed import Compressed
from .derivatives import pick, total_derivatives
from .equations import Equations
from .layout import Layout
from .pivots import Eliminated, Elimination
from .signature import Structure


class Plan(NamedTuple):
    """All that is known of a reduced system before it is evaluated."""

    layout: Layout
    entries: Compressed
    elimination: Elimination
    order: int
    unlifted: Structure  # with the fewest differentiations
    example: np.ndarray  # of x
    implicit: bool  # whether the equations may be nonlinear in the leading derivatives

    def jets(
        self, z: Float[Array, " a"], w: Float[Array, " n"] | None, differentiations: int
    ) -> tuple[Array, ...]:
        return self.layout.jets(z, w, self.order + 1 + differentiations)

    def jets_of_states(
        self, z: Float[Array, " a"], w: Float[Array, " n"] | None, differentiations: int
    ) -> tuple[Array, ...]:
        """Return the derivatives for equations of states alone. The others, evaluated with them,
        have to stay finite, and
        of moderate size where they cancel: for unknowns that are not states those in `w` are
        taken, without derivatives, or the example."""
        x, *others = self.jets(z, None, differentiations)
        known = self.layout.jet(0).index
        known = (known >= 0) & (known < self.layout.num_states)
        rest = jnp.asarray(self.example, x.dtype)
        if w is not None:
            rest = self.layout.jet(0)(jnp.zeros_like(z), jax.lax.stop_gradient(w))
        return jnp.where(known, x, rest), *others

    @property
    def differentiations(self) -> int:
        return int(self.layout.structure.c.max(initial=0))


class Static:
    """Anything, compared by identity."""

    def __init__(self, plan: Plan):
        self.plan = plan


class HighestDerivatives(AbstractEquations):
    """`F_i^(c_i) = 0` for the leading derivatives `w_j = x_j^(d_j)`, linear in them unless the form
    is implicit, at one state."""

    equations: Equations
    t: Array
    z: Float[Array, " a"]
    args: Args
    static: Static = eqx.field(static=True)

    def point(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        return z

    def residual(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self._residual(x)

    def _residual(self, w: Float[Array, " n"] | None) -> Float[Array, " n"]:
        plan = self.static.plan
        c, rows = plan.layout.structure.c, plan.layout.aliases.rows
        order = plan.differentiations
        jets = plan.jets(self.z, w, order)
        levels = total_derivatives(self.equations, self.t, jets, self.args, order)
        parts = [pick(levels[k], rows[c == k]) for k in range(order + 1)]
        return pick(jnp.concatenate(parts), np.argsort(np.argsort(c, kind="stable")))

    def linearize(self, x: Float[Array, " n"]) -> Eliminated:
        plan = self.static.plan
        return Eliminated.of(plan.elimination, plan.entries, self._derivatives(x))

    def matrix(self, w: Float[Array, " n"] | None = None) -> Float[Array, "n n"]:
        return self.static.plan.entries.matrix(self._derivatives(w))

    def _derivatives(self, w: Float[Array, " n"] | None) -> Array:
        """The same for all `w` unless the form is implicit."""
        plan = self.static.plan
        jets = plan.jets(self.z, w if plan.implicit else None, 0)
        return plan.entries.derivatives(self.equations, self.t, jets, self.args)

    def solve(self) -> Float[Array, " n"]:
        """NaN where the equations do not determine all of them. The derivative is that of the
        solution: only the residual is differentiated, not the matrix."""
        fixed = without_derivative(self)
        matrix = fixed.linearize(self.z)
        w = -matrix.solve(fixed._residual(None))
        w = implicit_root(self, jnp.where(matrix.full_rank, w, 0))
        # Added, not selected: the derivative of a discarded NaN would be NaN.
        return w + jnp.where(matrix.full_rank, 0, jnp.nan).astype(w.dtype)
