"""A reduced system: its vector field, its manifold, and all unknowns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.shapes import shapes
from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.checks import check_state
from .._constraint.constraint import AbstractConstraint
from .._constraint.residual import as_time
from .._linalg.newton import implicit_root, without_derivative
from .analysis import Analysis
from .equations import ResidualEquations
from .highest_derivatives import HighestDerivatives


_SINGULAR = (
    "The equations of `F` do not determine all derivatives at `{y}`: some of them depend on the others there "
    "(redundant), or `{y}` is a singular configuration. `dae.consistent_state`, called outside of `jit`, says which."
)


class Reduced(eqx.Module):
    """Equations with their analysis, shared by all parts of a reduced system."""

    equations: ResidualEquations
    analysis: Analysis = eqx.field(static=True)

    def leading_equations(self, t: Any, z: Array, args: Args) -> HighestDerivatives:
        return HighestDerivatives(self.equations, as_time(t, z.dtype), z, args, self.analysis)

    def split(self, y: Y) -> tuple[Array, Array | None]:
        """Return the state `z`, and the leading derivatives if they belong to it. Refuse what is not a
        state, such as the unknowns of the user's equations."""
        check_state(y, "z")
        states, implicit = self.analysis.layout.num_states, self.analysis.implicit
        size = states + len(self.analysis.c) * implicit
        if not eqx.is_array_like(y) or jnp.shape(y) != (size,):
            raise ValueError(
                f"The state of a reduced system is one vector of shape ({size},), with the names in `dae.report.states`; "
                f"got {shapes(y)}. `dae.consistent_state` makes one from a guess of x; of many states take `jax.vmap`."
            )
        return (y[:states], y[states:]) if implicit else (y, None)

    def field(self, t: RealScalarLike, y: Float[Array, " states"], args: Args) -> Array:
        """Return the vector field on the state.

        In the form of index 1 the leading derivatives are unknowns `w` of their own after the state,

            z' = (z, w),   0 = F_i^(c_i)(t, z, w),

        so that equations nonlinear in them need neither be differentiated once more nor solved in the
        vector field: a Rosenbrock method does both at once.
        """
        z, w = self.split(y)
        leading, rate = self.leading_equations(t, z, args), self.analysis.layout.rate()
        if w is None:
            return rate(z, leading.solve())
        return jnp.concatenate([rate(z, w), leading.residual(w)])

    def hidden_constraints(
        self,
        t: RealScalarLike,
        z: Float[Array, " a"],
        args: Args,
        first: np.ndarray | int,
        end: np.ndarray,
        w: Float[Array, " n"] | None = None,
    ) -> Float[Array, " m"]:
        """Return `F_i^(k)` for `first_i <= k < end_i`. They do not depend on the leading derivatives
        `w`, but where these cancel in combinations of equations their size matters: give `w` like those
        of `z`. Without combinations the example is used, where everything is finite."""
        order = int(end.max(initial=0)) - 1
        if order < 0:
            return jnp.zeros((0,), z.dtype)
        w = w if self.equations.combinations else None
        jets, t = self.analysis.jets_of_states(z, w, order), as_time(t, z.dtype)
        return self.analysis.differentiated(self.equations, t, jets, args, first, end)

    def unknowns_with_derivatives(
        self, t: RealScalarLike, y: Float[Array, " states"], args: Args, number: int
    ) -> list[Float[Array, " n"]]:
        """Return `x, x', ...` up to derivative `number`, by differentiating along the solution."""
        layout = self.analysis.layout
        z, w = self.split(y)
        equations = self.leading_equations(t, z, args)
        if w is None:
            w = equations.solve()
        else:
            # Steps leave an error in derivatives that do not count in theirs; a Newton step removes it.
            fixed, w = without_derivative((equations, w))
            w = w - fixed.linearize(w).solve(fixed.residual(w))

        def leading(t: Array, z: Array) -> Array:
            """Return the leading derivatives as a function, without solving for them again."""
            return implicit_root(self.leading_equations(t, z, args), w)

        def differentiated(function: Callable) -> Callable:
            along = lambda t, z: (jnp.ones_like(t), layout.rate()(z, leading(t, z)))
            return lambda t, z: jax.jvp(function, (t, z), along(t, z))[1]

        further = layout.most_beyond(number)
        t, function, found = as_time(t, z.dtype), leading, []
        for _ in range(further + 1):
            found.append(function(t, z))
            function = differentiated(function)
        known = jnp.concatenate(found)
        return [layout.jet(k, further)(z, known) for k in range(number + 1)]


class ReducedConstraint(AbstractConstraint):
    """`F_i = 0, F_i' = 0, ..., F_i^(c_i - 1) = 0`: the constraints that the equations and their
    derivatives impose on the state alone. Lower derivatives first. Built by `reduce_dae`."""

    system: Reduced
    redundant: bool = eqx.field(static=True, default=False)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Float[Array, " m"]:
        z, w = self.system.split(y)
        return self.system.hidden_constraints(t, z, args, 0, self.system.analysis.c, w)

    def faults(self, t, y, args=None) -> tuple[tuple[BoolScalar, str], ...]:
        z, w = self.system.split(jfu.ravel_pytree(y)[0])
        matrix = self.system.leading_equations(t, z, args).linearize(z if w is None else w)
        return ((~matrix.usable, _SINGULAR),)
