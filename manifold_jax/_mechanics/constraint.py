"""The manifold of a mechanical system: constraints on positions and on velocities."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.correction import ConstraintNormals, without_normal_part
from .._constraint.projection_info import ProjectionInfo
from .._constraint.residual import as_time, residual_vector
from .._constraint.settings import NewtonProjection
from .._linalg.rows import multiply
from .._linalg.sparse import Choice, Structure, structure_of
from .correction import InverseMetrics, TwoStages
from .kinematics import Kinematics


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
    `J v` is never formed. ConstraintNormals are those of the velocities.
    """

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable  # (t, q, v, args)
    redundant: bool = eqx.field(static=True)
    structure: Choice = eqx.field(static=True, default="dense")

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Any:
        equations = Kinematics.of(self, y)
        x, w = equations.flat(y)
        t = jnp.asarray(t, x.dtype)
        return equations.position(t, x, args), equations.velocity(t, w, (x, args))

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Y, ProjectionInfo]:
        fallback = y if fallback is None else fallback
        x, _ = jfu.ravel_pytree(y)
        stages = self._stages(projection, t, y, args, directions)
        stages = stages if directions is None else stages.dense()
        corrected, roots = stages.correct(y, fallback, far)
        return corrected, ProjectionInfo.of_correction(x, *roots)

    def normals(self, projection, t, y, args=None) -> ConstraintNormals:
        stages = self._stages(projection, t, y, args, None).dense()
        return stages.normals(*stages.equations.flat(y)).normals

    def structure_at(self, t, y, args=None) -> Structure | None:
        return whole_structure(self, t, y, args) if self.is_sparse(t, y, args) else None

    def is_sparse(self, t: RealScalarLike, y: Y, args: Args) -> bool:
        """Whether Jacobians are not held as arrays. Known while tracing."""
        equations = Kinematics.of(self, y)
        x, w = equations.flat(y)
        return equations.structure_at(as_time(t, x.dtype), x, w, args) is not None

    def push_forward(self, t, y, args, directions, vector) -> Y:
        """Positions first; the velocities depend on them."""
        equations = Kinematics.of(self, y)
        x, w = equations.flat(y)
        e_x, e_w = equations.flat(vector)
        t = as_time(t, x.dtype)
        C, p = equations.dense().rows(t, x, w, args)
        if p > 0:
            positions = ConstraintNormals(C[:p], directions[:p])
            e_x = without_normal_part(positions, e_x, multiply(C[:p], e_x), self.redundant)
        velocity = lambda x, w: equations.velocity(t, w, (x, args))
        _, rate = jax.jvp(velocity, (x, w), (e_x, e_w))
        e_w = without_normal_part(ConstraintNormals(C, directions), e_w, rate, self.redundant)
        return equations.unravel(e_x), equations.unravel(e_w)

    def faults(self, t, y, args=None) -> tuple[tuple[BoolScalar, str], ...]:
        equations = Kinematics.of(self, y)
        x, w = equations.flat(y)
        t = as_time(t, x.dtype)
        mass = equations.mass(t, x, w, args, equations.rows(t, x, w, args)[0])
        return (~mass.positive, _NOT_POSITIVE), (~mass.symmetric, _ASYMMETRIC)

    def _stages(
        self,
        projection: NewtonProjection,
        t: RealScalarLike,
        y: Y,
        args: Args,
        directions: Float[Array, "m k"] | None,
    ) -> TwoStages:
        equations = Kinematics.of(self, y)
        metrics = InverseMetrics.of(projection, y)
        t = as_time(t, jnp.result_type(*jax.tree_util.tree_leaves(y)))
        return TwoStages(equations, t, args, projection, metrics, directions, self.redundant)


def whole_structure(
    constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args
) -> Structure | None:
    """Return the structure of all equations with respect to the whole state, if they are sparse,
    too."""
    x, unravel = jfu.ravel_pytree(y)
    t = as_time(t, x.dtype)
    return structure_of(((lambda x: residual_vector(constraint, t, unravel(x), args), x),))
