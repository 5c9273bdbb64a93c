"""The manifold of a mechanical system: constraints on positions and on velocities."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp

from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.correction import ConstraintNormals, without_normal_part
from .._constraint.projection_info import ProjectionInfo
from .._constraint.residual import as_time, residual_vector
from .._linalg.rows import multiply
from .._linalg.sparse import Choice, Structure, structure_of
from .correction import InverseMetrics, PositionVelocityCorrection
from .kinematics import flat, Kinematics


_ASYMMETRIC = (
    "`mass_matrix` is not symmetric at `{y}`. Return `(M + M.T) / 2`, or check its formula."
)
_NOT_POSITIVE = (
    "`mass_matrix` is not positive definite at `{y}` (a matrix may be singular, but not for motions that the "
    "constraints allow; a scalar or a diagonal must be positive). Check its signs and that no mass is missing."
)


class MechanicalConstraint(AbstractConstraint):
    r"""The constraints of a [`MechanicalSystem`][] on its state `(q, v)`, `k` numbers each:
    `phi(t, q) = 0`, `J v + dphi/dt = 0` with `J = dphi/dq`, and `a(t, q, v) = 0`.

    Built by `MechanicalSystem.constraint`. Corrections use its structure: first the positions,
    then the velocities, which is a linear problem, with the same matrix. The derivative of
    `J v` is never formed. The normals are those of the velocities.
    """

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable  # (t, q, v, args)
    redundant: bool = eqx.field(static=True)
    structure: Choice = eqx.field(static=True, default="dense")

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Any:
        here = Kinematics.of(self, t, y, args)
        here = here._replace(t=jnp.asarray(here.t, here.x.dtype))
        return here.positions(), here.velocities()

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Y, ProjectionInfo]:
        fallback = y if fallback is None else fallback
        x, _ = jfu.ravel_pytree(y)
        here = Kinematics.of(self, t, y, args)
        here = here if directions is None else here.dense()
        metrics = InverseMetrics.of(projection, y)
        correction = PositionVelocityCorrection(here, projection, metrics, directions)
        corrected, roots = correction.correct(fallback, far)
        return corrected, ProjectionInfo.of_correction(x, *roots)

    def normals(self, projection, t, y, args=None) -> ConstraintNormals:
        here = Kinematics.of(self, t, y, args).dense()
        metrics = InverseMetrics.of(projection, y)
        correction = PositionVelocityCorrection(here, projection, metrics, None)
        return correction.normals(here.x, here.w).normals

    def structure_at(self, t, y, args=None) -> Structure | None:
        return whole_structure(self, t, y, args) if self.is_sparse(t, y, args) else None

    def is_sparse(self, t: RealScalarLike, y: Y, args: Args) -> bool:
        """Whether Jacobians are not held as arrays. Known while tracing."""
        return Kinematics.of(self, t, y, args).structure_here() is not None

    def push_forward(self, t, y, args, directions, vector) -> Y:
        """Apply the derivative to the positions first; the velocities depend on them."""
        here, (e_x, e_w) = Kinematics.of(self, t, y, args), flat(vector)
        C, p = here.dense().rows()
        if p > 0:
            positions = ConstraintNormals(C[:p], directions[:p])
            e_x = without_normal_part(positions, e_x, multiply(C[:p], e_x), self.redundant)
        velocity = lambda x, w: here.velocity(here.t, w, (x, args))
        _, rate = jax.jvp(velocity, (here.x, here.w), (e_x, e_w))
        e_w = without_normal_part(ConstraintNormals(C, directions), e_w, rate, self.redundant)
        return here.unravel(e_x), here.unravel(e_w)

    def faults(self, t, y, args=None) -> tuple[tuple[BoolScalar, str], ...]:
        here = Kinematics.of(self, t, y, args)
        mass = here.mass(here.rows()[0])
        return (~mass.positive, _NOT_POSITIVE), (~mass.symmetric, _ASYMMETRIC)


def whole_structure(
    constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args
) -> Structure | None:
    """Return the structure of all equations with respect to the whole state, if they are sparse, too."""
    x, unravel = jfu.ravel_pytree(y)
    t = as_time(t, x.dtype)
    return structure_of(((lambda x: residual_vector(constraint, t, unravel(x), args), x),))
