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

from .._base.compat import nonlinear_failure, time_direction
from .._base.compensated import Compensated
from .._base.compositions import composed, Order
from .._base.types import Args, RealScalarLike, Y
from .._jaxpr.incidence import incidence
from .hermite import MechanicalHermite
from .kinematics import flat, Kinematics
from .motion import flat_force
from .separable_step import Point, SeparableStep
from .system import MechanicalSystem
from .variational_step import VariationalStep


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

    @eqx.filter_jit  # traced once
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
        x, w = flat(y0)
        unravel = jfu.ravel_pytree(y0[0])[1]
        direction = jnp.asarray(time_direction(terms), x.dtype)
        length = jnp.asarray(t1 - t0, x.dtype) * direction
        t = jnp.asarray(t0, x.dtype) * direction
        step = self._second_order(t, y0, unravel, args)
        here = step.at(t, x, w)
        rests = Compensated(x, solver_state.x), Compensated(w, solver_state.w)
        start = Point(t, *rests, here, here.usable)

        def advance(point: Point, fraction: Any) -> Point:
            return step.made(point, fraction * length)

        end = composed(advance, start, self.composition, x.dtype)
        y1 = unravel(end.x.value), unravel(end.w.value)
        result = RESULTS.where(end.success, RESULTS.successful, nonlinear_failure())
        dense_info = dict(y0=y0, y1=y1, length=length)
        return y1, None, dense_info, Rests(end.x.rest, end.w.rest), result

    def _second_order(
        self, t: Array, y: Y, unravel: Callable, args: Args
    ) -> SeparableStep | VariationalStep:
        """Choose the step, while tracing, by what masses and forces depend on."""
        if _is_separable(self.system, t, y, args):
            return SeparableStep(self.system, unravel, args)
        if self.system.redundant:
            raise ValueError(
                "`system` may have constraints that depend on each other, `redundant=True`, and masses that depend on the "
                "positions or forces that depend on the velocities: `rattle` needs independent ones then. Leave the "
                "dependent ones out (of an assembly by `without_dependent_equations()`)."
            )
        return VariationalStep(self.system, unravel, args)


def _is_separable(system: MechanicalSystem, t: Array, y: Y, args: Args) -> bool:
    """Whether masses are constant, and forces do not depend on velocities."""
    here = Kinematics.of(system, t, y, args)

    def masses(x: Float[Array, " k"]) -> Array:
        leaves = jtu.tree_leaves(here._replace(x=x).mass_values())
        return jnp.concatenate([jnp.ravel(leaf).astype(x.dtype) for leaf in leaves])

    def forces(w: Float[Array, " k"]) -> Array:
        q, v = here.unravel(here.x), here.unravel(w)
        return flat_force(system.force(here.t, q, v, args), q, w)

    return not (_depends(masses, here.x) or _depends(forces, here.w))


def _depends(function: Callable, x: Float[Array, " k"]) -> bool:
    return bool(incidence(function, (x, np.ones((x.size, 1), bool))).depends.any())
