"""The step of RATTLE for constant masses and forces of time and positions: explicit but for the constraints."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.compensated import Compensated
from .._base.types import Args, BoolScalar
from .._constraint.correction import (
    ConstraintNormals,
    CorrectionEquations,
    FactoredGram,
    solve_correction,
)
from .._constraint.settings import NewtonProjection
from .._linalg.rows import combine, directions_of
from .kinematics import Kinematics
from .mass import InvertedBlocks, Mass
from .motion import flat_force
from .system import MechanicalSystem


class Point(NamedTuple):
    """Where a step begins or ends: positions and velocities, what the step needs of the place, which is the
    end of the step before, and whether the steps so far succeeded."""

    t: Array
    x: Compensated
    w: Compensated
    here: Any
    success: BoolScalar


class _ExplicitStart(NamedTuple):
    """Accelerations without constraints, and the constraints linearized."""

    free: Float[Array, " k"]
    factored: FactoredGram
    usable: BoolScalar


class SeparableStep(NamedTuple):
    """A step of second order."""

    system: MechanicalSystem
    unravel: Callable
    args: Args

    def at(self, t: Any, x: Array, w: Array) -> _ExplicitStart:
        mass, factored = linearized(self._kinematics(t, x, w))
        q, v = self.unravel(x), self.unravel(w)
        force = flat_force(self.system.force(t, q, v, self.args), q, x)
        return _ExplicitStart(
            mass.solve(force), factored, mass.valid & factored.factorization.usable
        )

    def made(self, start: Point, h: Any) -> Point:
        t, x, w, here, success = start
        after = t + h
        half = w.plus(0.5 * h * here.free)
        free = x.moved(h, half).value
        directions = here.factored.normals.directions
        residual = self._kinematics(t, free, w.value).position
        residual = convert_closure(residual, after, free, self.args)
        equations = CorrectionEquations(
            residual, after, free, self.args, None, directions, self.system.redundant
        )
        root = solve_correction(equations, free, NewtonProjection(), False, here.factored)
        half = half.plus(combine(jnp.where(root.success, root.z, 0), directions) / h)
        x = x.moved(h, half)
        there = self.at(after, x.value, w.value)
        w = half.plus(0.5 * h * there.free)
        w = on_constraints(self._kinematics(after, x.value, w.value), w, there.factored)
        return Point(after, x, w, there, success & root.success & there.usable)

    def _kinematics(self, t: Any, x: Array, w: Array) -> Kinematics:
        return Kinematics.of(self.system, t, (self.unravel(x), self.unravel(w)), self.args)


def linearized(here: Kinematics) -> tuple[Mass | InvertedBlocks, FactoredGram]:
    """Return the masses, and the constraints with their directions in the metric of these, factored."""
    J, _ = here.rows()
    mass = here.mass(J)
    normals = ConstraintNormals(J, directions_of(mass, J))
    return mass, FactoredGram.of(normals, here.system.redundant)


def on_constraints(here: Kinematics, w: Compensated, factored: FactoredGram) -> Compensated:
    """Return the velocities nearest to `w`, in the metric of the masses, that the constraints allow."""
    impulse = factored.solve(here.velocities())
    return w.plus(-combine(impulse, factored.normals.directions))
