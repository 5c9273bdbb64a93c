r"""Vector fields whose solutions are attracted to the manifold (constraint stabilization).

With `V = W^-1 G^T`, so that `G^+ = V (G V)^-1` is a generalized inverse of `G`, and the sign `s = +-1`
of the direction in which time is integrated.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.correction import CorrectionEquations, equations_of, solve_correction
from .._constraint.settings import NewtonProjection
from .._linalg.rows import combine


def refuse_negative(name: str, gain: RealScalarLike) -> None:
    if isinstance(gain, int | float) and not gain >= 0:
        raise ValueError(
            f"`{name}` must not be negative, got {gain}: violations would grow instead of decay. "
            "Integrating backwards needs no change of sign."
        )


def is_stable(gain: RealScalarLike, step: RealScalarLike, solver: dfx.AbstractSolver) -> BoolScalar:
    """Whether the approximation of `exp(-gain t)` decays."""
    gain = jnp.asarray(gain)
    # A step at the limit itself may exceed it by rounding.
    return (gain >= 0) & (gain * jnp.abs(step) <= 1.0001 * stability_interval(solver))


def stability_interval(solver: dfx.AbstractSolver) -> float:
    """Return the largest `x` with `|R(-s)| <= 1` for all `0 <= s <= x`, where `R` is the stability
    function of an explicit Runge-Kutta method; infinite for other solvers."""
    tableau: Any = getattr(solver, "tableau", None)
    if not isinstance(solver, dfx.AbstractERK) or not isinstance(tableau, dfx.ButcherTableau):
        return 2.0 if isinstance(solver, dfx.Euler) else float("inf")
    stages = tableau.num_stages
    A = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    power, coefficients = np.ones(stages), [1.0]
    for _ in range(stages):
        coefficients.append(float(np.asarray(tableau.b_sol) @ power))
        power = A @ power
    R = np.polynomial.Polynomial([c * (-1) ** k for k, c in enumerate(coefficients)])
    roots = (R * R - 1).roots()
    crossings = roots.real[(np.abs(roots.imag) < 1e-6) & (roots.real > 1e-3)]
    return float(min(crossings, default=np.inf))


Field: TypeAlias = Callable[[RealScalarLike, Y, Args], Y]


class AbstractStabilization(eqx.Module):
    """A modification of a vector field `f` that makes violations decay, for [`Stabilized`][].

    Implementations provide `field`, `rate`, which says how stiff it is, and `ends_on_manifold`, whether
    the ends of steps are to be corrected.
    """

    @property
    @abc.abstractmethod
    def rate(self) -> RealScalarLike:
        """The largest rate of decay, 1/time. Steps `h` with `rate * h` beyond the stability interval of
        the solver are rejected; with 0 that is left to the error estimate."""

    @property
    def ends_on_manifold(self) -> bool:
        """Whether every step ends on the manifold, with all that is returned. Known while tracing."""
        return False

    @abc.abstractmethod
    def field(
        self,
        f: Field,
        constraint: AbstractConstraint,
        projection: NewtonProjection,
        sign: RealScalarLike,
        t: RealScalarLike,
        y: Y,
        args: Args,
    ) -> Y:
        """Return the stabilized field at the true time `t` and the state `y` of one trajectory, like
        `y`.

        `sign` is the direction of integration: a term that decays forwards in time must be multiplied
        by it to decay backwards, too. NaN where the field is not defined: such a step is rejected.
        """


class InvariantStabilization(AbstractStabilization):
    r"""`F = f - s gain G^+ g`, approximate constraint stabilization; with `projected=True`
    `F = f - G^+ (G f + dg/dt + s gain g)`, for which `g` decays exactly like `exp(-gain |t|)`.

    **Arguments:**

    - `gain`: 1/time, not negative. Without `projected` it must exceed the rate at which `f`
        itself leaves the manifold.
    - `projected`: first take the part of `f` that is normal to the manifold away. With gain 0
        this is the projected vector field, for which `g` keeps its value: neutral, violations
        drift linearly with the errors of the solver.

    One Jacobian per evaluation of the field, no iteration. `gain * h` must stay within the stability
    interval of the solver on the negative real axis (Euler 2, Tsit5 3.5, Dopri5 3.3); a step beyond it
    is rejected, or fails if steps are constant. Large gains make the problem stiff.

    Source: Ascher, Chin & Reich, Numer. Math. 67 (1994) 131-149 (stabilization of invariants).
    """

    gain: RealScalarLike
    projected: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        refuse_negative("gain", self.gain)

    @property
    def rate(self) -> RealScalarLike:
        return self.gain

    def field(self, f, constraint, projection, sign, t, y, args):
        derivative = f(t, y, args)
        w, unravel = jfu.ravel_pytree(derivative)
        # For the whole state, whatever the constraint: components are not corrected separately.
        equations = _equations(constraint, t, y, args, projection)
        x, t = equations.x, equations.t
        factored = equations.factored()
        rate = sign * self.gain * equations.residual(x)
        if self.projected:
            residual = lambda t, x: equations.function(t, x, equations.args)
            rate = rate + jax.jvp(residual, (t, x), (jnp.ones_like(t), w))[1]
        undefined = jnp.where(factored.factorization.usable, 0, jnp.nan).astype(w.dtype)
        return unravel(w - combine(factored.solve(rate), factored.normals.directions) + undefined)


class ExactStabilization(AbstractStabilization):
    r"""`F = f(pi(y)) + s gain (pi(y) - y)` with `pi(y)` the point of the manifold nearest to `y`.

    The distance from the manifold decays like `exp(-gain |t|)`, whatever `f` does outside,
    as `f(pi(y))` is tangent and `pi(y) - y` normal. With gain 0 it is `F = f(pi(y))` with the
    end of every step projected: everything returned is on the manifold.

    **Arguments:**

    - `gain`: 1/time, not negative; a Python number 0 selects the variant above.

    One nonlinear solve per evaluation of the field, whose derivatives off the manifold do not
    matter. `gain * h` must stay within the stability interval of the solver as for
    [`InvariantStabilization`][], of which this is the exact form.

    Source: the exact constraint stabilization of Sudarsan & Keerthi (1998), section 3.3, as
    read from its name and purpose: the text available did not have its formula.
    """

    gain: RealScalarLike

    def __check_init__(self):
        refuse_negative("gain", self.gain)

    @property
    def rate(self) -> RealScalarLike:
        return self.gain

    @property
    def ends_on_manifold(self) -> bool:
        return isinstance(self.gain, int | float) and self.gain == 0

    def field(self, f, constraint, projection, sign, t, y, args):
        # For the whole state: the nearest point in all components.
        equations = _equations(constraint, t, y, args, projection)
        x, unravel = equations.x, jfu.ravel_pytree(y)[1]
        root = solve_correction(equations, jax.lax.stop_gradient(x), projection, False)
        if not self.ends_on_manifold:
            # Corrected again along the normals at that point, which gives the nearest point to one
            # order higher. Otherwise the change of the distance would have an error of its square.
            normals = equations.starting_at(root.p).normals()
            again = equations.along(normals.directions)
            root = solve_correction(again, jax.lax.stop_gradient(x), projection, False)
        point = unravel(root.p)
        undefined = jnp.where(root.success, 0.0, jnp.nan)

        def stabilized(derivative, p, y):
            return derivative + sign * self.gain * (p - y) + undefined.astype(p.dtype)

        return jtu.tree_map(stabilized, f(t, point, args), point, y)


def _equations(constraint, t, y, args, projection) -> CorrectionEquations:
    structure = constraint.structure_at(t, y, args)
    return equations_of(
        constraint, t, y, args, projection, constraint.redundant, structure=structure
    )
