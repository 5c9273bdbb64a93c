"""The equations of one Rosenbrock step, for the vector of all numbers of the state."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.compat import directed, time_direction, undirected
from .._base.types import Args, RealScalarLike, Y
from .._linalg.rows import product
from .._linalg.sparse import Choice, SparseMatrix, Sparsity
from .algebraic import LinearizedEquations
from .mass_matrix import mass_values, MassMatrixTerm, ravelled_like
from .sparsity import choose_sparsity


Vector = Float[Array, " n"]


class System(NamedTuple):
    """`M y' = f` over one step from `t0` to `t1`.

    - `terms`: the terms of `f` alone.
    - `mass`: the mass matrix, or `None` for the identity.
    """

    terms: Any
    mass: MassMatrixTerm | None
    t0: RealScalarLike
    t1: RealScalarLike
    y0: Y
    args: Args

    @staticmethod
    def of(terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args) -> "System":
        mass = undirected(terms)
        if not isinstance(mass, MassMatrixTerm):
            return System(terms, None, t0, t1, y0, args)
        terms = directed(dfx.ODETerm(mass.vector_field), time_direction(terms))
        return System(terms, mass, t0, t1, y0, args)

    @property
    def step(self) -> Array:
        return jnp.asarray(self.t1) - self.t0

    def time(self, c: float) -> Array:
        return self.t0 + c * self.step

    def increment(self, t: RealScalarLike, x: Vector) -> Vector:
        """Return `h f(t, x)`."""
        control = self.terms.contr(self.t0, self.t1)
        value = self.terms.vf_prod(t, self._unravel(x), self.args, control)
        return ravelled_like(self.y0, value)

    def mass_at(self, t: RealScalarLike, x: Vector) -> Float[Array, "..."] | None:
        if self.mass is None:
            return None
        true_time = t * time_direction(self.terms)
        return mass_values(self.mass.mass, true_time, self._unravel(x), self.args)

    def counted_error(self, error: Vector) -> Vector:
        """Return the error of a step, zero where it does not count."""
        return error if self.mass is None else self.mass.counted_error(error)

    def sparsity(self, choice: Choice, x0: Vector, displacement: Vector | None) -> Sparsity | None:
        """Return how the linear systems of the step are solved."""
        mass = self.mass_at(self.t0, x0)
        massless = None if self.mass is None else self.mass.massless(x0.size)
        if displacement is None:
            increment = lambda x: self.increment(self.t0, x)
            return choose_sparsity(choice, increment, x0, mass, massless)

        def both(x: Vector) -> Vector:
            return self.increment(self.t0, x) + product(self.mass_at(self.t0, x), displacement)  # pyright: ignore[reportArgumentType]

        return choose_sparsity(choice, both, x0, mass, massless)

    def linearized(
        self, x0: Vector, displacement: Vector | None, sparsity: Sparsity | None = None
    ) -> tuple[Vector, Any, Vector]:
        """Return `h f`, its Jacobian and `h` times its derivative by time at the beginning; if the mass
        depends on the state, the derivatives are those of `h f - M displacement`."""

        def rest(t: RealScalarLike, x: Vector) -> tuple[Vector, Vector]:
            value = self.increment(t, x)
            if displacement is None:
                return value, value
            return value - product(self.mass_at(t, x), displacement), value  # pyright: ignore[reportArgumentType]

        t0 = jnp.asarray(self.t0)
        _, column, f0 = jax.linearize(lambda x: rest(t0, x), x0, has_aux=True)
        if sparsity is None:
            J = jax.vmap(column, out_axes=1)(jnp.eye(x0.size, dtype=x0.dtype))
        else:
            J = SparseMatrix.of_columns(column, sparsity.pattern, x0.dtype)
        _, T = jax.jvp(lambda t: rest(t, x0)[0], (t0,), (self.step.astype(t0.dtype),))
        return f0, J, T

    def at_start(self, x0: Vector, choice: Choice) -> tuple[LinearizedEquations, Vector]:
        """Return the equations and the mass matrix at the beginning, and `y'` in the step's direction."""
        direction = time_direction(self.terms)
        t0 = self.t0 * direction
        equations = self.mass.equations(self.y0, self.args)  # pyright: ignore[reportOptionalMemberAccess]
        at = equations.with_sparsity(choice, t0, x0).at(t0, x0)
        return at, at.derivative * jnp.asarray(direction, x0.dtype)

    def refreshed(
        self, made_jump: Any, derivative: Vector | None, x0: Vector, choice: Choice
    ) -> Vector | None:
        """Return the carried derivative `y'`, evaluated again after a jump of the field."""
        if derivative is None or made_jump is False:
            return derivative
        return jax.lax.cond(made_jump, lambda: self.at_start(x0, choice)[1], lambda: derivative)

    def _unravel(self, x: Vector) -> Y:
        return jfu.ravel_pytree(self.y0)[1](x)
