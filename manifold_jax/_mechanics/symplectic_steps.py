"""Steps of RATTLE and of its compositions."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.compat import nonlinear_failure, time_direction
from .._base.compensated import Compensated
from .._base.compositions import composed, Order
from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.correction import (
    ConstraintNormals,
    CorrectionEquations,
    FactoredGram,
    solve_correction,
)
from .._constraint.settings import NewtonProjection
from .._jaxpr.incidence import incidence
from .._linalg.rows import combine, directions_of
from .hermite import MechanicalHermite
from .kinematics import flat, Kinematics
from .motion import flat_force
from .system import MechanicalSystem


class _Here(NamedTuple):
    """What a step needs of its start, which is the end of the one before: accelerations without
    constraints, and the constraints linearized."""

    free: Float[Array, " k"]
    factored: FactoredGram
    usable: BoolScalar


class _Point(NamedTuple):
    """Where a step begins or ends: positions and velocities, and whether the steps so far succeeded."""

    t: Array
    x: Compensated
    w: Compensated
    here: _Here
    success: BoolScalar


class Rests(NamedTuple):
    """The memory of the steps: what rounding has taken from positions and velocities."""

    x: Float[Array, " k"]
    w: Float[Array, " k"]


class RATTLESteps(dfx.AbstractSolver):
    """The steps of [`rattle`][], which has the formulas.

    Positions and velocities are sums of increments whose rounding errors are carried along, from step to
    step in the state of the solver. What is left are those of the increments, smaller by the length of a
    step. The multipliers have errors of rounding size over `h`, along the normals: one step takes back what
    the one before has added, if the velocity in the middle is the one by which positions move.
    """

    system: MechanicalSystem
    composition: Order = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable[..., dfx.AbstractLocalInterpolation]:  # pyright: ignore
        return MechanicalHermite

    def order(self, terms: Any) -> int:
        return self.composition

    def init(self, terms, t0, t1, y0: Y, args: Args) -> Rests:
        x, w = flat(y0)
        return Rests(jnp.zeros_like(x), jnp.zeros_like(w))

    def func(self, terms, t0, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Rests,
        made_jump,
    ) -> Any:
        _check_separable(self.system, t0, y0, args)
        x, w = flat(y0)
        unravel = jfu.ravel_pytree(y0[0])[1]
        direction = jnp.asarray(time_direction(terms), x.dtype)
        length = jnp.asarray(t1 - t0, x.dtype) * direction
        t = jnp.asarray(t0, x.dtype) * direction
        here = self._here(t, x, w, unravel, args)
        rests = Compensated(x, solver_state.x), Compensated(w, solver_state.w)
        start = _Point(t, *rests, here, here.usable)

        def advance(point: _Point, fraction: Any) -> _Point:
            return self._step(point, fraction * length, unravel, args)

        end = composed(advance, start, self.composition, x.dtype)
        y1 = unravel(end.x.value), unravel(end.w.value)
        result = RESULTS.where(end.success, RESULTS.successful, nonlinear_failure())
        dense_info = dict(y0=y0, y1=y1, length=length)
        return y1, None, dense_info, Rests(end.x.rest, end.w.rest), result

    def _here(self, t: Any, x: Any, w: Any, unravel: Callable, args: Args) -> _Here:
        y = unravel(x), unravel(w)
        kinematics = Kinematics.of(self.system, t, y, args)
        J, _ = kinematics.rows()
        mass = kinematics.mass(J)
        normals = ConstraintNormals(J, directions_of(mass, J))
        factored = FactoredGram.of(normals, self.system.redundant)
        force = flat_force(self.system.force(t, *y, args), y[0], x)
        return _Here(mass.solve(force), factored, mass.valid & factored.factorization.usable)

    def _step(self, start: _Point, h: Any, unravel: Callable, args: Args) -> _Point:
        """Make one step of second order."""
        t, x, w, here, success = start
        after = t + h
        half = w.plus(0.5 * h * here.free)
        free = x.moved(h, half).value
        system, directions = self.system, here.factored.normals.directions
        residual = Kinematics.of(system, t, (unravel(free), unravel(w.value)), args).position
        residual = convert_closure(residual, after, free, args)
        equations = CorrectionEquations(
            residual, after, free, args, None, directions, system.redundant
        )
        root = solve_correction(equations, free, NewtonProjection(), False, here.factored)
        half = half.plus(combine(jnp.where(root.success, root.z, 0), directions) / h)
        x = x.moved(h, half)
        there = self._here(after, x.value, w.value, unravel, args)
        w = half.plus(0.5 * h * there.free)
        kinematics = Kinematics.of(system, after, (unravel(x.value), unravel(w.value)), args)
        impulse = there.factored.solve(kinematics.velocities())
        w = w.plus(-combine(impulse, there.factored.normals.directions))
        return _Point(after, x, w, there, success & root.success & there.usable)


def _check_separable(system: MechanicalSystem, t: Any, y: Y, args: Args) -> None:
    """Refuse, while tracing, masses that depend on the positions, and forces that depend on velocities."""
    here = Kinematics.of(system, t, y, args)

    def masses(x: Float[Array, " k"]) -> Array:
        leaves = jtu.tree_leaves(here._replace(x=x).mass_values())
        return jnp.concatenate([jnp.ravel(leaf).astype(x.dtype) for leaf in leaves])

    def forces(w: Float[Array, " k"]) -> Array:
        q, v = here.unravel(here.x), here.unravel(w)
        return flat_force(system.force(here.t, q, v, args), q, w)

    if _depends(masses, here.x):
        raise ValueError(
            "The masses of `system` depend on the positions; RATTLE needs constant ones. Use Cartesian coordinates, or "
            "`mj.Projected(diffrax.Dopri8(), system.constraint)`."
        )
    if _depends(forces, here.w):
        raise ValueError(
            "The `force` of `system` depends on the velocities; RATTLE needs forces of time and positions. Leave friction "
            "and gyroscopic terms out, or use `mj.Projected(diffrax.Dopri8(), system.constraint)`."
        )


def _depends(function: Callable, x: Float[Array, " k"]) -> bool:
    return bool(incidence(function, (x, np.ones((x.size, 1), bool))).depends.any())
