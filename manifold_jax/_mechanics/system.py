"""Constrained mechanics: from mass matrix, constraints and forces to a vector field."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args, RealScalarLike, Y
from .._directed_term import DirectedTerm
from .._linear import combine, factorize, gram, gram_written_out, multiply
from .._user_function import check_function
from .constraint import MechanicalConstraint
from .kinematics import check_mechanical_state, Kinematics
from .lagrangian import LagrangianForce
from .mass import ConfigurationMass, LagrangianMass, Mass
from .stabilization import Baumgarte, VelocityStabilization


class MechanicalSystem(eqx.Module):
    r"""A mechanical system with constraints, `n` coordinates and `m` constraints:

        M(q) a + J^T lambda = Q(t, q, v),   phi(t, q) = 0,   J = dphi/dq.

    ```python
    rod = mj.MechanicalSystem(
        mass_matrix=1.0,
        constraint=lambda t, q, args: q @ q - 1.0,
        force=lambda t, q, v, args: jnp.array([0.0, -9.81]),
    )
    sol = mj.diffeqsolve(rod.terms, mj.Projected(dfx.Tsit5(), rod.constraint), ...)
    ```

    The state is `(q, v)` with `v = dq/dt`; `q` is any pytree of real arrays. `terms` is the
    vector field `(v, a)` and `constraint` the manifold, both of index 1: `phi`, its time
    derivative, and the constraints on velocities. Corrections move first the positions and
    then the velocities, orthogonally in the metric of the masses.

    **Arguments:**

    - `mass_matrix`: `M(q, args)` or a constant: a scalar, a diagonal of shape `(n,)` or of the
        structure and shapes of `q`, or a symmetric matrix `(n, n)` in the order of
        `ravel_pytree(q)`. A matrix may be singular as long as no motion that the constraints allow
        is without mass (quaternions).
    - `constraint`: `phi(t, q, args)`, any pytree of real arrays; time-dependent (rheonomic)
        constraints are allowed. `None` if there are only constraints on velocities.
    - `force`: `Q(t, q, v, args)`, like `q`: applied forces and, for configuration-dependent
        masses, the gyroscopic terms. [`MechanicalSystem.from_lagrangian`][] derives those.
    - `velocity_constraint`: `a(t, q, v, args) = A(t, q) v - b(t, q)`, constraints that are not
        derivatives of positions (nonholonomic): rolling, skating.
    - `stabilization`: [`Baumgarte`][] or [`VelocityStabilization`][]; not needed with
        [`Projected`][] or [`LocalCoordinates`][].
    - `redundant`: constraints may depend on each other (closed loops described twice). The
        accelerations are those of the independent ones, the multipliers the ones of least
        norm. Otherwise dependent constraints give an error at the start. What counts as
        dependent is decided anew in every evaluation, also beside the manifold: directions in
        which the equations are a hundred times weaker than in the strongest. Write equations
        in like units, and keep tolerances below about 1e-3.

    Where the accelerations are not defined (a mass matrix that is not positive definite or not
    symmetric, dependent constraints) they are NaN: steps that meet them are rejected and the
    solve ends with a failure code, also in a batch.

    Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 11.
    """

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable
    force: Callable
    stabilization: Baumgarte | VelocityStabilization | None
    redundant: bool = eqx.field(static=True)

    def __init__(
        self,
        mass_matrix: Any,
        constraint: Callable | None,
        force: Callable,
        *,
        velocity_constraint: Callable | None = None,
        stabilization: Baumgarte | VelocityStabilization | None = None,
        redundant: bool = False,
    ):
        _check_arguments(constraint, force, velocity_constraint, stabilization)
        own = isinstance(mass_matrix, LagrangianMass | ConfigurationMass)  # of another system
        if callable(mass_matrix) and not own:
            check_function("mass_matrix", mass_matrix, "M(q, args)")
        self.mass_matrix = mass_matrix if own else ConfigurationMass(mass_matrix)
        self.holonomic = constraint
        self.nonholonomic = velocity_constraint
        self.force = force
        self.stabilization = stabilization
        self.redundant = redundant

    @classmethod
    def from_lagrangian(
        cls,
        lagrangian: Callable,
        constraint: Callable | None,
        force: Callable | None = None,
        **kwargs,
    ) -> "MechanicalSystem":
        r"""The system of a Lagrangian `L(t, q, v, args)`, kinetic minus potential energy:

            d/dt dL/dv - dL/dq + J^T lambda = Q(t, q, v, args).

        **Arguments:**

        - `lagrangian`: `L(t, q, v, args)`, a scalar.
        - `constraint`, and by keyword `velocity_constraint`, `stabilization`, `redundant`: as
            for [`MechanicalSystem`][].
        - `force`: forces that have no potential, such as friction; `None` for none.

        Masses and gyroscopic terms are second derivatives of `L`; write them out where the
        time to compile matters.
        """
        check_function("lagrangian", lagrangian, "L(t, q, v, args)")
        if force is not None:
            check_function("force", force, "Q(t, q, v, args)")
        mass = LagrangianMass(lagrangian)
        return cls(mass, constraint, LagrangianForce(lagrangian, force), **kwargs)

    @property
    def constraint(self) -> MechanicalConstraint:
        """The manifold, for [`Projected`][], [`Stabilized`][] and [`LocalCoordinates`][]."""
        return MechanicalConstraint(
            self.holonomic, self.nonholonomic, self.mass_matrix, self.redundant
        )

    @property
    def terms(self) -> dfx.AbstractTerm:
        """The vector field on `(q, v)`, a Diffrax term."""
        if isinstance(self.stabilization, Baumgarte):
            return DirectedTerm(self._stabilized_field, self.stabilization.rate)
        return dfx.ODETerm(self._field)

    def accelerations(self, t: RealScalarLike, y: Y, args: Args = None) -> Y:
        """`a` of `M a + J^T lambda = Q`, like `q`, without stabilization."""
        motion = _Motion(self, t, y, args)
        return motion.unravel(motion.solve(motion.bias)[0])

    def multipliers(self, t: RealScalarLike, y: Y, args: Args = None) -> Float[Array, " m"]:
        """`lambda` of `M a + J^T lambda = Q`: first those of `constraint` in the order of
        `ravel_pytree`, then those of `velocity_constraint`. The constraint force on the
        coordinates is `-J^T lambda`. With `redundant=True` the solution of least norm."""
        motion = _Motion(self, t, y, args)
        return motion.solve(motion.bias)[1]

    def _field(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        motion = _Motion(self, t, y, args)
        a, _ = motion.solve(motion.bias)
        if not isinstance(self.stabilization, VelocityStabilization):
            return y[1], motion.unravel(a)
        return motion.unravel(motion.stabilized_velocity()), motion.unravel(a)

    def _stabilized_field(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, Y]:
        """The field, and the part of it that changes sign with the direction of time."""
        assert isinstance(self.stabilization, Baumgarte)
        motion = _Motion(self, t, y, args)
        alpha, beta = self.stabilization.alpha, self.stabilization.beta
        rate = motion.equations.velocity(motion.t, motion.w, (motion.x, args))
        p = motion.num_positions
        stiffness = motion.bias.at[:p].add(
            beta**2 * motion.equations.position(motion.t, motion.x, args)
        )
        a, _ = motion.solve(stiffness)
        damping = motion.constrained(alpha * rate.at[:p].multiply(2))
        still = jax.tree_util.tree_map(jnp.zeros_like, y[1])
        return (y[1], motion.unravel(a)), (still, motion.unravel(-damping))


class _Motion:
    """Everything at one state: `C a = -bias`, the mass matrix, and `C M^-1 C^T`, factored."""

    def __init__(self, system: MechanicalSystem, t: RealScalarLike, y: Y, args: Args):
        q, v = check_mechanical_state(y)
        self.equations = Kinematics.of(system, y)
        self.unravel = self.equations.unravel
        self.x, self.w = self.equations.flat(y)
        self.t, self.args = jnp.asarray(t, self.x.dtype), args
        self.C, self.num_positions = self.equations.rows(self.t, self.x, self.w, args)
        self.bias = self.equations.acceleration_bias(self.t, self.x, self.w, args)
        self.force = _flat_force(system.force(t, q, v, args), q, self.x)
        self.mass: Mass = self.equations.mass(self.t, self.x, self.w, args, self.C)
        self.directions = self.mass.solve(self.C)
        self.redundant = system.redundant
        self.factorization = factorize(gram_written_out(self.C, self.directions), system.redundant)

    def solve(self, bias: Float[Array, " m"]) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Accelerations and multipliers of `M a + C^T lambda = Q`, `C a = -bias`."""
        force = self.force
        if self.mass.augmentation is not None:
            force = force - combine(self.mass.augmentation * bias, self.C)
        free = self.mass.solve(force)
        multipliers = self.factorization.solve(multiply(self.C, free) + bias)
        # Added, not selected: the derivative of a discarded NaN would be NaN.
        valid = self.mass.valid & self.factorization.full_rank
        undefined = jnp.where(valid, 0, jnp.nan).astype(free.dtype)
        return free - combine(multipliers, self.directions) + undefined, multipliers + undefined

    def constrained(self, b: Float[Array, " m"]) -> Float[Array, " n"]:
        """The smallest change of the velocities, in the metric of the masses, with `C dv = b`."""
        return combine(self.factorization.solve(b), self.directions)

    def stabilized_velocity(self) -> Float[Array, " n"]:
        p = self.num_positions
        rate = self.equations.velocity(self.t, self.w, (self.x, self.args))[:p]
        J, directions = self.C[:p], self.directions[:p]
        return self.w - combine(
            factorize(gram(J, directions), self.redundant).solve(rate), directions
        )


def _flat_force(force: Any, q: Y, x: Float[Array, " n"]) -> Float[Array, " n"]:
    shapes = lambda tree: jax.tree_util.tree_map(jnp.shape, tree)
    if shapes(force) != shapes(q):
        raise ValueError(
            f"`force` must return Q(t, q, v, args) of the structure and shapes of q, {shapes(q)}, got {shapes(force)}."
        )
    return jfu.ravel_pytree(force)[0].astype(x.dtype)


def _check_arguments(
    constraint: Any, force: Any, velocity_constraint: Any, stabilization: Any
) -> None:
    check_function("force", force, "Q(t, q, v, args)")
    if constraint is not None:
        check_function("constraint", constraint, "phi(t, q, args)")
    if velocity_constraint is not None:
        check_function("velocity_constraint", velocity_constraint, "a(t, q, v, args)")
    if constraint is None and velocity_constraint is None:
        raise ValueError(
            "`constraint` is None and there is no `velocity_constraint`: without constraints use "
            "`diffrax.ODETerm` and the solver alone."
        )
    if not isinstance(stabilization, Baumgarte | VelocityStabilization | None):
        raise TypeError(
            "`stabilization` must be `mj.Baumgarte(alpha, beta)` or `mj.VelocityStabilization()`, got "
            f"{type(stabilization).__name__}. Others are arguments of `mj.Stabilized`."
        )
