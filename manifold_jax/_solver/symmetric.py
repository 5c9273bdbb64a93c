"""Symmetric projection: the manifold by reversible steps, for long times."""

from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.compat import nonlinear_failure, time_direction
from .._base.compensated import Compensated
from .._base.compositions import check_order, composed, Order
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._constraint.checks import check_constraint_type
from .._constraint.constraint import AbstractConstraint
from .._constraint.residual import jacobian, residual_vector, row_scale
from .._constraint.settings import NewtonProjection
from .._linalg.newton import chord, implicit_root, SquareSystem, without_derivative
from .base import check_one_equation
from .on_manifold import AbstractStepsOnManifold


# The most simplified Newton iterations of a step. Each reduces the error by a factor of about `h^2`.
_MOST = 30


class _Place(NamedTuple):
    """Where a step begins or ends, in the time of Diffrax, and whether the steps so far succeeded."""

    t: FloatScalar
    y: Compensated
    success: BoolScalar


class SymmetricSteps(dfx.AbstractSolver):
    """The steps of [`SymmetricProjection`][], which has the formulas. Rounding errors are carried from step
    to step."""

    constraint: AbstractConstraint
    composition: Order = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms: Any) -> int:
        return self.composition

    def init(self, terms, t0, t1, y0: Y, args: Args) -> Float[Array, " n"]:
        return jnp.zeros_like(jfu.ravel_pytree(y0)[0])

    def func(self, terms, t0, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    @eqx.filter_jit  # traced once
    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Float[Array, " n"],
        made_jump,
    ) -> Any:
        x0, unravel = jfu.ravel_pytree(y0)

        def advance(point: _Place, fraction: Any) -> _Place:
            after = point.t + fraction * (t1 - t0)
            return _Step(self.constraint, terms, point.t, after, unravel, args).made(point)

        start = _Place(jnp.asarray(t0), Compensated(x0, solver_state), jnp.asarray(True))
        end = composed(advance, start, self.composition, start.t.dtype)
        y1, control = unravel(end.y.value), terms.contr(t0, t1)
        slopes = [terms.vf_prod(t, y, args, control) for t, y in ((t0, y0), (t1, y1))]
        dense_info = dict(y0=y0, y1=y1, k0=slopes[0], k1=slopes[1])
        result = RESULTS.where(end.success, RESULTS.successful, nonlinear_failure())
        return y1, None, dense_info, end.y.rest, result


class _Step(NamedTuple):
    """One step of the midpoint rule, as equations for its increment and the multipliers."""

    constraint: AbstractConstraint
    terms: Any
    t0: FloatScalar
    t1: FloatScalar
    unravel: Any
    args: Args

    def made(self, start: _Place) -> _Place:
        """Solve the equations by simplified Newton iterations. The increment is computed once more from
        their solution: it is then as accurate as it is small."""
        y = start.y.value
        G0, scale = self._normals_at_start(y)
        guess = jnp.concatenate([self._moved(self.t0, y), jnp.zeros_like(scale)])
        split = lambda z: (z[: y.size], z[y.size :])

        def increment(z: Array) -> tuple[Array, Array]:
            """Return the increment that `z` implies, and the equations at the end."""
            d, multipliers = split(z)
            g, pull_back = jax.vjp(lambda y1: self._residual(self.t1, y1), y + d)
            first, last = multipliers @ G0, pull_back(multipliers)[0]
            # From y + first to y + d - last.
            field = self._moved((self.t0 + self.t1) / 2, y + (first + d - last) / 2)
            return first + field + last, g

        def equations(z: Array) -> Array:
            new, g = increment(z)
            return jnp.concatenate([split(z)[0] - new, g])

        system = SquareSystem(convert_closure(equations, guess))
        fixed, guess = without_derivative((system, guess))
        linearization = fixed.linearize(guess)
        sizes = lax.stop_gradient(jnp.concatenate([jnp.abs(y) + 1, scale]))
        root = chord(fixed, linearization, guess, guess, fixed.residual(guess), sizes, _MOST)
        success = root.scaled_residual <= NewtonProjection().tolerance_for(y.dtype)
        z = implicit_root(system, jnp.where(success, root.z, guess))
        end = start.y.plus(increment(z)[0])
        return _Place(self.t1, end, start.success & success)

    def _residual(self, t: FloatScalar, y: Array) -> Array:
        time = t * time_direction(self.terms)
        return residual_vector(self.constraint, time, self.unravel(y), self.args)

    def _normals_at_start(self, y: Array) -> tuple[Array, Array]:
        G = jacobian(lambda y: self._residual(self.t0, y), y)[1]
        return G, row_scale(G, y)

    def _moved(self, t: FloatScalar, y: Array) -> Array:
        control = self.terms.contr(self.t0, self.t1)
        k = self.terms.vf_prod(t, self.unravel(y), self.args, control)
        return jfu.ravel_pytree(k)[0].astype(y.dtype)


class SymmetricProjection(AbstractStepsOnManifold):
    r"""Reversible steps on a manifold, for long times: where the equations and the constraint are reversible
    the errors of energies and other quantities stay bounded, for as long as the steps are all of one length.

    A step of length `h` of `y' = f(t, y)`, `g(t, y) = 0` leaves the manifold along its normals, makes a step
    of the implicit midpoint rule there, and comes back with the same multipliers:

    $$\hat y_0 = y_0 + G(y_0)^T \mu, \quad \hat y_1 = \hat y_0 + h f\bigl(t_{1/2}, \tfrac12 (\hat y_0 + \hat y_1)\bigr),
    \quad y_1 = \hat y_1 + G(y_1)^T \mu, \quad g(t_1, y_1) = 0.$$

    Interchanging `y_0` and `y_1`, with `-h`, leaves these equations as they are; a projection at the end of the
    step alone, [`Projected`][], does not have that property whatever the method inside.

    ```python
    energy = mj.Invariants(hamiltonian, y0=y0)
    sol = mj.diffeqsolve(terms, mj.SymmetricProjection(energy), 0.0, 1000.0, 0.01, y0, max_steps=None)
    ```

    **Arguments:**

    - `constraint`: the manifold, of independent equations.
    - `order`: 2, or compositions of such steps of order 4 (five of them, Suzuki) or 6 (nine, Kahan & Li).

    **Raises:**

    `TypeError` for something else than a constraint, `ValueError` for another order and for redundant
    equations; when it is solved, `ValueError` for terms that are not an ordinary differential equation.

    For small systems: a step factors a matrix of `n + m` rows and columns. Steps have a constant size, dense
    output is of third order. Rounding errors are carried from step to step, as by [`rattle`][], which is
    cheaper and symplectic, too: prefer it for mechanical systems that it takes. For short times prefer
    [`Projected`][] around an explicit method of high order.

    Sources: Hairer, BIT 40 (2000) 726-734; Hairer, Lubich & Wanner, Geometric Numerical Integration (2006),
    sections V.4.1 and V.3.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection

    def __init__(self, constraint: AbstractConstraint, *, order: Order = 2):
        check_constraint_type(constraint, "SymmetricProjection(constraint)")
        check_order(order)
        if constraint.redundant:
            raise ValueError(
                "`constraint` may have equations that depend on each other: their multipliers are not determined. Give "
                "`SymmetricProjection` independent ones, without `redundant=True`."
            )
        self.inner = SymmetricSteps(constraint, order)
        self.constraint = constraint
        self.projection = NewtonProjection()
        self.bends_interpolant = True
        self.bounds_error = False
        self.state_of_coordinates = None

    def prepare_terms(self, terms: Any) -> Any:
        check_one_equation(terms, "SymmetricProjection")
        return terms
