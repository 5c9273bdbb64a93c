"""The manifold of a mechanical system with auxiliary states."""

import dataclasses
from typing import Any

import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.shapes import shapes
from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.correction import ConstraintNormals
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .._linalg.sparse import Structure
from .constraint import MechanicalConstraint, whole_structure


class ExtendedConstraint(AbstractConstraint):
    """The constraints of a [`MechanicalSystem`][] on its state `(q, v, z)`: those of the motion
    `(q, v)`, and those of the auxiliary states `z` alone, if there are any.

    Built by `MechanicalSystem.constraint`. Both are corrected separately. The normals are those of the
    motion: in local coordinates `z` is corrected along its own.
    """

    motion: MechanicalConstraint
    auxiliary: AbstractConstraint | None

    @property
    def redundant(self) -> bool:
        return self.motion.redundant or (self.auxiliary is not None and self.auxiliary.redundant)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Any:
        motion, z = split(y)
        residual = self.motion(t, motion, args)
        return residual if self.auxiliary is None else (*residual, self.auxiliary(t, z, args))

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Y, ProjectionInfo]:
        motion, z = split(y)
        safe, safe_z = split(y if fallback is None else fallback)
        of_motion, of_auxiliary = _projections(projection, y)
        motion, info = self.motion.correct(
            of_motion, t, motion, args, fallback=safe, far=far, directions=directions
        )
        if self.auxiliary is None:
            return (*motion, z), info
        z, more = self.auxiliary.correct(of_auxiliary, t, z, args, fallback=safe_z, far=far)
        return (*motion, z), ProjectionInfo.of_parts(info, more)

    def normals(self, projection, t, y, args=None) -> ConstraintNormals:
        return self.motion.normals(_projections(projection, y)[0], t, split(y)[0], args)

    def structure_at(self, t, y, args=None) -> Structure | None:
        sparse = self.motion.is_sparse(t, split(y)[0], args)
        return whole_structure(self, t, y, args) if sparse else None

    def push_forward(self, t, y, args, directions: Float[Array, "m k"], vector) -> Y:
        (motion, z), (e, e_z) = split(y), split(vector)
        e = self.motion.push_forward(t, motion, args, directions, e)
        if self.auxiliary is not None:
            normals = self.auxiliary.normals(NewtonProjection(), t, z, args)
            e_z = self.auxiliary.push_forward(t, z, args, normals.directions, e_z)
        return (*e, e_z)

    def faults(self, t, y, args=None):
        motion, z = split(y)
        faults = self.motion.faults(t, motion, args)
        return faults if self.auxiliary is None else (*faults, *self.auxiliary.faults(t, z, args))


def split(y: Y) -> tuple[tuple[Y, Y], Y]:
    """Return `(q, v)` and `z`. Refuse, while tracing, states that are not `(q, v, z)`."""
    if not (isinstance(y, tuple) and len(y) == 3):
        raise ValueError(
            "`y` must be the tuple `(q, v, z)` of positions, velocities and the auxiliary states of a mechanical "
            f"system with `auxiliary`, got shapes {shapes(y)}. Write e.g. `y0 = (q0, jnp.zeros_like(q0), z0)`."
        )
    q, v, z = y
    return (q, v), z


def _projections(projection: NewtonProjection, y: Y) -> tuple[NewtonProjection, NewtonProjection]:
    """Return the projections of motion and auxiliary states, each with its part of the metric."""
    if projection.metric is None or isinstance(projection.metric, str):
        return projection, projection
    if jtu.tree_structure(projection.metric) != jtu.tree_structure(y):
        projection.inverse_metric(y)  # raises
    of_part = lambda metric: dataclasses.replace(projection, metric=metric)
    motion, z = split(projection.metric)
    return of_part(motion), of_part(z)
