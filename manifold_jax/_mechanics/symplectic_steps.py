"""RATTLE: symplectic, time-reversible steps of mechanical systems, and compositions of them."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.closure import convert_closure
from .._base.compat import nonlinear_failure, time_direction
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
from .._solver.base import AbstractOneStepSolver
from .._solver.projected import Projected
from .kinematics import flat, Kinematics
from .motion import flat_force
from .system import MechanicalSystem


Order: TypeAlias = Literal[2, 4, 6]

_SUZUKI = 1 / (4 - 4 ** (1 / 3))
# The lengths of the steps that make one. Sources: Suzuki, Phys. Lett. A 146 (1990) 319-323, and Kahan & Li,
# Math. Comp. 66 (1997) 1089-1099 (nine stages), as in Hairer, Lubich & Wanner (2006), section V.3.
_HALF = (0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.082213596293550800230)  # fmt: skip
COMPOSITIONS: dict[int, tuple[float, ...]] = {
    2: (1.0,),
    4: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI, _SUZUKI, _SUZUKI),
    6: (*_HALF, 1 - 2 * sum(_HALF), *_HALF[::-1]),
}


class _Here(NamedTuple):
    """What a step needs of its start, which is the end of the one before: accelerations without
    constraints, and the constraints linearized."""

    free: Float[Array, " k"]
    factored: FactoredGram
    usable: BoolScalar


class RATTLESteps(AbstractOneStepSolver):
    """The steps of [`rattle`][], which has the formulas."""

    system: MechanicalSystem
    composition: int = eqx.field(static=True)

    term_structure: ClassVar = dfx.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable[..., dfx.AbstractLocalInterpolation]:  # pyright: ignore
        return MechanicalHermite

    def order(self, terms: Any) -> int:
        return self.composition

    def init(self, terms, t0, t1, y0: Y, args: Args) -> None:
        return None

    def func(self, terms, t0, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state,
        made_jump,
    ) -> Any:
        _check_separable(self.system, t0, y0, args)
        direction = time_direction(terms)
        x, w = flat(y0)
        unravel = jfu.ravel_pytree(y0[0])[1]
        start, length = t0 * direction, (t1 - t0) * direction
        fractions = jnp.asarray(COMPOSITIONS[self.composition], x.dtype)

        def advance(state: Any, fraction: Any) -> Any:
            t, x, w, here, success = state
            t, x, w, here, okay = self._step(t, fraction * length, x, w, here, unravel, args)
            return (t, x, w, here, success & okay), None

        here = self._here(start, x, w, unravel, args)
        state = (jnp.asarray(start, x.dtype), x, w, here, here.usable)
        if fractions.size == 1:
            state, _ = advance(state, fractions[0])
        else:
            state, _ = lax.scan(advance, state, fractions)
        _, x, w, _, success = state
        y1 = unravel(x), unravel(w)
        result = RESULTS.where(success, RESULTS.successful, nonlinear_failure())
        dense_info = dict(y0=y0, y1=y1, direction=jnp.asarray(direction, x.dtype))
        return y1, None, dense_info, None, result

    def _here(self, t: Any, x: Any, w: Any, unravel: Callable, args: Args) -> _Here:
        y = unravel(x), unravel(w)
        kinematics = Kinematics.of(self.system, t, y, args)
        J, _ = kinematics.rows()
        mass = kinematics.mass(J)
        normals = ConstraintNormals(J, directions_of(mass, J))
        factored = FactoredGram.of(normals, self.system.redundant)
        force = flat_force(self.system.force(t, *y, args), y[0], x)
        return _Here(mass.solve(force), factored, mass.valid & factored.factorization.usable)

    def _step(
        self, t: Any, h: Any, x: Any, w: Any, here: _Here, unravel: Callable, args: Args
    ) -> tuple[Any, ...]:
        """Make one step of second order."""
        after = t + h
        free = x + h * (w + 0.5 * h * here.free)
        system, directions = self.system, here.factored.normals.directions
        residual = Kinematics.of(system, t, (unravel(x), unravel(w)), args).position
        residual = convert_closure(residual, after, free, args)
        equations = CorrectionEquations(
            residual, after, free, args, None, directions, system.redundant
        )
        root = solve_correction(equations, x, NewtonProjection(), False, here.factored)
        middle = (root.p - x) / h
        there = self._here(after, root.p, middle, unravel, args)
        w = middle + 0.5 * h * there.free
        kinematics = Kinematics.of(system, after, (unravel(root.p), unravel(w)), args)
        rates = kinematics.velocities()
        w = w - combine(there.factored.solve(rates), there.factored.normals.directions)
        return after, root.p, w, there, root.success & there.usable


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


class MechanicalHermite(dfx.AbstractLocalInterpolation):
    """Positions as the cubic polynomial with the velocities at both ends, and velocities as its derivative."""

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Y
    y1: Y
    direction: RealScalarLike

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(length == 0, 1, length)
        h = length * self.direction
        (q0, v0), (q1, v1) = self.y0, self.y1

        def position(q0: Array, q1: Array, v0: Array, v1: Array) -> Array:
            turn = s * s * (3 - 2 * s)
            bend = s * (1 - s) * h * ((1 - s) * v0 - s * v1)
            return (q0 + turn * (q1 - q0) + bend).astype(q0.dtype)

        def velocity(q0: Array, q1: Array, v0: Array, v1: Array) -> Array:
            mean = (q1 - q0) / jnp.where(h == 0, 1, h)
            own = (1 - s) * (1 - 3 * s) * v0 - s * (2 - 3 * s) * v1
            return (6 * s * (1 - s) * mean + own).astype(v0.dtype)

        return tuple(jtu.tree_map(part, q0, q1, v0, v1) for part in (position, velocity))


def rattle(system: MechanicalSystem, *, order: Order = 2) -> Projected:
    r"""RATTLE as a solver for [`diffeqsolve`][], for long times: symplectic and time-reversible, so that the
    error of the energy stays bounded for as long as the steps are all of one length.

    A step of length `h` of `M v' = Q(t, q) - J^T lambda`, `phi(t, q) = 0`, with constant masses `M`:

    $$v_{1/2} = v_0 + \tfrac h2 M^{-1} (Q(q_0) - J(q_0)^T \lambda), \quad q_1 = q_0 + h\, v_{1/2}, \quad
    \phi(q_1) = 0,$$

    $$v_1 = v_{1/2} + \tfrac h2 M^{-1} (Q(q_1) - J(q_1)^T \mu), \quad \dot\phi(q_1, v_1) = 0.$$

    ```python
    solver = mj.rattle(system)
    sol = mj.diffeqsolve(system.terms, solver, 0.0, 1000.0, 0.01, y0, args, max_steps=None)
    ```

    **Arguments:**

    - `system`: that of the terms that are solved. Steps are made from its masses, forces and constraints and do
        not evaluate the `terms`: a force that is in these alone has no effect. With constant masses,
        forces that depend on time and positions only, and constraints on positions; all of them may
        depend on `args`.
    - `order`: 2, or compositions of such steps of order 4 (five of them, Suzuki) or 6 (nine, Kahan & Li).

    **Returns:**

    A [`Projected`][] hook around these steps: gradients, events, resets, ensembles and saved values are as
    for every other. Dense output is of third order between the steps. Steps have a constant size.

    **Raises:**

    `TypeError` for another system, `ValueError` for another order or constraints on velocities; when it is
    solved, `ValueError` for forces that depend on velocities and masses that depend on positions.

    Prefer an explicit method of high order for short times at tight tolerances.

    Sources: Andersen, J. Comput. Phys. 52 (1983) 24-34; Hairer, Lubich & Wanner, Geometric Numerical
    Integration (2006), sections VII.1.4 and V.3.
    """
    if not isinstance(system, MechanicalSystem):
        raise TypeError(
            f"`system` must be an `mj.MechanicalSystem`, got {type(system).__name__}. Of an assembly of `mj.multibody` "
            "pass its `system`."
        )
    if order not in COMPOSITIONS:
        raise ValueError(f"`order` must be 2, 4 or 6, got {order!r}.")
    if system.nonholonomic is not None or system.holonomic is None:
        raise ValueError(
            "`system` has constraints on velocities, which RATTLE has no symplectic steps for. Use "
            "`mj.Projected(diffrax.Dopri8(), system.constraint)`."
        )
    if system.auxiliary is not None:
        raise ValueError(
            "`system` has auxiliary states, which RATTLE does not take. Use `mj.Projected(diffrax.Dopri8(), "
            "system.constraint)`."
        )
    return Projected(RATTLESteps(system, order), system.constraint)
