"""The equations that are solved for the leading derivatives."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.dense import Factorization
from .._linalg.newton import AbstractEquations, implicit_root, without_derivative
from .._linalg.sparse import factorize_sparse, SparseMatrix
from .analysis import Analysis
from .block_elimination import Eliminated
from .derivatives import pick
from .equations import ResidualEquations


class HighestDerivatives(AbstractEquations):
    """The leading equations `F_i^(c_i) = 0` at one state, for the leading derivatives
    `w_j = x_j^(d_j)`; linear in them unless the form is implicit."""

    equations: ResidualEquations
    t: Array
    z: Float[Array, " a"]
    args: Args
    analysis: Analysis = eqx.field(static=True)

    def point(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        return z

    def residual(self, x: Float[Array, " n"] | None) -> Float[Array, " n"]:
        """Return the residual; `None` stands for zeros."""
        c = self.analysis.c
        jets = self.analysis.jets(self.z, x, int(c.max(initial=0)))
        values = self.analysis.differentiated(self.equations, self.t, jets, self.args, c, c + 1)
        return pick(values, np.argsort(np.argsort(c, kind="stable")))

    def linearize(self, x: Float[Array, " n"]) -> Eliminated | Factorization:
        analysis, derivatives = self.analysis, self._derivatives(x)
        if analysis.sparsity is None:
            return Eliminated.of(analysis.elimination, analysis.entries, derivatives)
        matrix = SparseMatrix(analysis.entries.values(derivatives), analysis.sparsity.pattern)
        return factorize_sparse(matrix, analysis.sparsity.method)

    def matrix(self, w: Float[Array, " n"] | None = None) -> Float[Array, "n n"]:
        return self.analysis.entries.matrix(self._derivatives(w))

    def _derivatives(self, w: Float[Array, " n"] | None) -> Array:
        """Return the derivatives of the residual: the same for all `w` unless the form is implicit."""
        jets = self.analysis.jets(self.z, w if self.analysis.implicit else None, 0)
        return self.analysis.entries.derivatives(self.equations, self.t, jets, self.args)

    def solve(self) -> Float[Array, " n"]:
        """Return the leading derivatives, NaN where the equations do not determine all of them. Only
        the residual is differentiated, not the matrix: the derivative is that of the solution."""
        fixed = without_derivative(self)
        matrix = fixed.linearize(self.z)
        w = -matrix.solve(fixed.residual(None))
        w = implicit_root(self, jnp.where(matrix.usable, w, 0))
        # Added, not selected: the derivative of a discarded NaN would be NaN.
        return w + jnp.where(matrix.usable, 0, jnp.nan).astype(w.dtype)
