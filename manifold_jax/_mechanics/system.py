"""Constrained mechanics: from mass matrix, constraints and forces to a vector field."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.errors import refuse_old_names
from .._base.shapes import are_alike, shapes
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.constraint import AbstractConstraint
from .._linalg.sparse import check_choice, Choice
from .._solver.terms import DirectedTerm
from .auxiliary import ExtendedConstraint
from .constraint import MechanicalConstraint
from .mass import ConfigurationMass, LagrangianMass
from .motion import EquationsOfMotion, LagrangianForce
from .stabilization import Baumgarte, VelocityStabilization


_old_names = refuse_old_names(
    constraint="position_constraint",
    further="auxiliary",
    further_constraint="auxiliary_constraint",
)


class MechanicalSystem(eqx.Module):
    r"""A mechanical system with constraints, `n` coordinates and `m` constraints:

        M(q) a + J^T lambda = Q(t, q, v),   phi(t, q) = 0,   J = dphi/dq.

    ```python
    rod = mj.MechanicalSystem(
        mass_matrix=1.0,
        position_constraint=lambda t, q, args: q @ q - 1.0,
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
        structure and shapes of `q`, or in the order of `ravel_pytree(q)` a symmetric matrix
        `(n, n)` or the blocks on its diagonal, `(bodies, d, d)` with `n = bodies * d`. A matrix may
        be singular as long as no motion that the constraints allow is without mass (quaternions).
    - `position_constraint`: `phi(t, q, args)`, any pytree of real arrays; time-dependent (rheonomic)
        constraints are allowed. `None` if there are only constraints on velocities.
    - `force`: `Q(t, q, v, args)`, like `q`: applied forces and, for configuration-dependent
        masses, the gyroscopic terms. [`MechanicalSystem.from_lagrangian`][] derives those.
    - `velocity_constraint`: `a(t, q, v, args) = A(t, q) v - b(t, q)`, constraints that are not
        derivatives of positions (nonholonomic): rolling, skating.
    - `auxiliary`: `z' = h(t, q, v, z, args)`, equations of auxiliary states `z` (any pytree): actuators,
        controllers, quadratures. The state is `(q, v, z)` then, and the force
        `Q(t, q, v, z, args)`; corrections leave `z` as it is.
    - `auxiliary_constraint`: a constraint on `z` alone, such as [`Sphere`][], which corrects it.
    - `stabilization`: [`Baumgarte`][] or [`VelocityStabilization`][]; not needed with
        [`Projected`][] or [`LocalCoordinates`][].
    - `redundant`: constraints may depend on each other (closed loops described twice). The
        accelerations are those of the independent ones, the multipliers those with the least
        forces. Otherwise dependent constraints give an error at the start. What counts as
        dependent is decided anew in every evaluation, also off the manifold: directions in
        which the equations, each scaled to a gradient of length one, are a hundred times weaker
        than in the strongest. Keep tolerances below about 1e-3. Where an independent equation is
        taken for dependent and not satisfied for it, accelerations are NaN.
    - `structure`: `"sparse"` for many constraints of few coordinates each (chains, trusses,
        molecules), at a cost that grows with their number `m`, not with `m^3`: `J M^-1 J^T`, reordered
        by reverse Cuthill-McKee, is eliminated in blocks of its bandwidth `w`, `m w^2` operations; all
        else are products with `J`, which is never formed. `"dense"` for matrices. `"auto"` takes
        sparse ones for 32 constraints or more if blocks are at most a sixth of that. Which constraint
        depends on which coordinates is found from the function itself, whatever the values: indices
        must be NumPy arrays that it closes over, not be in `args`. Sparse masses are scalars, diagonals
        or blocks, a block may be singular only in directions that constraints on its own coordinates
        exclude, and constraints may not depend on each other. [`LocalCoordinates`][] forms
        dense matrices whatever the structure.

    Where the accelerations are not defined (a mass matrix that is not positive definite or not
    symmetric, dependent constraints) they are NaN: steps that meet them are rejected and the
    solve ends with a failure code, also in a batch.

    Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 11.
    """

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable
    force: Callable
    auxiliary: Callable | None
    auxiliary_constraint: AbstractConstraint | None
    stabilization: Baumgarte | VelocityStabilization | None
    redundant: bool = eqx.field(static=True)
    structure: Choice = eqx.field(static=True)

    @_old_names
    def __init__(
        self,
        mass_matrix: Any,
        position_constraint: Callable | None,
        force: Callable,
        *,
        velocity_constraint: Callable | None = None,
        auxiliary: Callable | None = None,
        auxiliary_constraint: AbstractConstraint | None = None,
        stabilization: Baumgarte | VelocityStabilization | None = None,
        redundant: bool = False,
        structure: Choice = "auto",
    ):
        own = isinstance(mass_matrix, LagrangianMass | ConfigurationMass)  # of another system
        if callable(mass_matrix) and not own:
            check_function("mass_matrix", mass_matrix, "M(q, args)")
        self.mass_matrix = mass_matrix if own else ConfigurationMass(mass_matrix)
        self.holonomic = position_constraint
        self.nonholonomic = velocity_constraint
        self.force = force
        self.auxiliary = auxiliary
        self.auxiliary_constraint = auxiliary_constraint
        self.stabilization = stabilization
        self.redundant = redundant
        self.structure = structure

    def __check_init__(self):
        _check_force(self.force, self.auxiliary)
        if self.holonomic is not None:
            check_function("position_constraint", self.holonomic, "phi(t, q, args)")
        if self.nonholonomic is not None:
            check_function("velocity_constraint", self.nonholonomic, "a(t, q, v, args)")
        if self.holonomic is None and self.nonholonomic is None:
            raise ValueError(
                "`position_constraint` is None and there is no `velocity_constraint`: without constraints use "
                "`diffrax.ODETerm` and the solver alone."
            )
        if not isinstance(self.stabilization, Baumgarte | VelocityStabilization | None):
            raise TypeError(
                "`stabilization` must be `mj.Baumgarte(alpha, beta)` or `mj.VelocityStabilization()`, got "
                f"{type(self.stabilization).__name__}. Others are arguments of `mj.Stabilized`."
            )
        if self.auxiliary is not None:
            check_function("auxiliary", self.auxiliary, "h(t, q, v, z, args)")
        elif self.auxiliary_constraint is not None:
            raise ValueError(
                "`auxiliary_constraint` is for the states of `auxiliary`, which is None. Constraints on positions and "
                "velocities are `position_constraint` and `velocity_constraint`."
            )
        if not isinstance(self.auxiliary_constraint, AbstractConstraint | None):
            raise TypeError(
                "`auxiliary_constraint` must be an `mj.Constraint` on z, or another one, got "
                f"{type(self.auxiliary_constraint).__name__}. Write e.g. `mj.Constraint(lambda t, z, args: z @ z - 1.0)`."
            )
        check_choice(self.structure, self.redundant)

    @classmethod
    @_old_names
    def from_lagrangian(
        cls,
        lagrangian: Callable,
        position_constraint: Callable | None,
        force: Callable | None = None,
        **kwargs,
    ) -> "MechanicalSystem":
        r"""The system of a Lagrangian `L(t, q, v, args)`, kinetic minus potential energy:

            d/dt dL/dv - dL/dq + J^T lambda = Q(t, q, v, args).

        **Arguments:**

        - `lagrangian`: `L(t, q, v, args)`, a scalar.
        - `position_constraint`, and by keyword `velocity_constraint`, `stabilization`, `redundant`: as
            for [`MechanicalSystem`][]. The mass matrix is a full one, so that matrices are dense.
        - `force`: forces that have no potential, such as friction; `None` for none.

        Masses and gyroscopic terms are second derivatives of `L`; write them out where the
        time to compile matters.
        """
        check_function("lagrangian", lagrangian, "L(t, q, v, args)")
        if force is not None:
            _check_force(force, kwargs.get("auxiliary"))
        mass = LagrangianMass(lagrangian)
        return cls(mass, position_constraint, LagrangianForce(lagrangian, force), **kwargs)

    @property
    def constraint(self) -> MechanicalConstraint | ExtendedConstraint:
        """The manifold, for [`Projected`][], [`Stabilized`][] and [`LocalCoordinates`][]."""
        motion = MechanicalConstraint(
            holonomic=self.holonomic,
            nonholonomic=self.nonholonomic,
            mass_matrix=self.mass_matrix,
            redundant=self.redundant,
            structure=self.structure,
        )
        if self.auxiliary is None:
            return motion
        return ExtendedConstraint(motion=motion, auxiliary=self.auxiliary_constraint)  # pyright: ignore[reportCallIssue]

    @property
    def terms(self) -> dfx.AbstractTerm:
        """The vector field on `(q, v)`, a Diffrax term."""
        if isinstance(self.stabilization, Baumgarte):
            return DirectedTerm(self._stabilized_field, self.stabilization.rate)
        return dfx.ODETerm(self._field)

    def accelerations(self, t: RealScalarLike, y: Y, args: Args = None) -> Y:
        """Return `a` of `M a + J^T lambda = Q`, like `q`, without stabilization."""
        motion = EquationsOfMotion(self, t, y, args)
        return motion.unravel(motion.solve(motion.bias)[0])

    def multipliers(self, t: RealScalarLike, y: Y, args: Args = None) -> Float[Array, " m"]:
        """Return `lambda` of `M a + J^T lambda = Q`: first those of `position_constraint` in the order
        of `ravel_pytree`, then those of `velocity_constraint`. The constraint force on the coordinates
        is `-J^T lambda`. With `redundant=True` the solution with the least forces: the sum of
        `lambda_i^2 (J M^-1 J^T)_ii` is minimal."""
        motion = EquationsOfMotion(self, t, y, args)
        return motion.solve(motion.bias)[1]

    def _field(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        motion = EquationsOfMotion(self, t, y, args)
        a, _ = motion.solve(motion.bias)
        velocity = y[1]
        if isinstance(self.stabilization, VelocityStabilization):
            velocity = motion.unravel(motion.stabilized_velocity())
        return velocity, motion.unravel(a), *self._auxiliary_rates(t, y, args)

    def _auxiliary_rates(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, ...]:
        if self.auxiliary is None:
            return ()
        z, rates = y[2], self.auxiliary(t, *y, args)
        if not are_alike(rates, z):
            raise ValueError(
                f"`auxiliary` must return h(t, q, v, z, args) of the structure and shapes of z, {shapes(z)}, got {shapes(rates)}."
            )
        return (rates,)

    def _stabilized_field(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, Y]:
        """Return the field, and the part of it that changes sign with the direction of time."""
        assert isinstance(self.stabilization, Baumgarte)
        motion = EquationsOfMotion(self, t, y, args)
        alpha, beta = self.stabilization.alpha, self.stabilization.beta
        rate, p = motion.here.velocities(), motion.num_positions
        a, _ = motion.solve(motion.bias.at[:p].add(beta**2 * motion.here.positions()))
        damping = motion.constrained(alpha * rate.at[:p].multiply(2))
        still = jax.tree_util.tree_map(jnp.zeros_like, y)
        field = y[1], motion.unravel(a), *self._auxiliary_rates(t, y, args)
        return field, (still[0], motion.unravel(-damping), *still[2:])


def _check_force(force: Any, auxiliary: Any) -> None:
    call = "Q(t, q, v, args)" if auxiliary is None else "Q(t, q, v, z, args)"
    check_function("force", force, call)
