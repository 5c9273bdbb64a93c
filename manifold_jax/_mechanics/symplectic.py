"""RATTLE: symplectic, time-reversible steps of mechanical systems, and compositions of them."""

from typing import Any

import diffrax as dfx

from .._base.compositions import check_order, Order
from .._constraint.constraint import AbstractConstraint
from .._constraint.settings import NewtonProjection
from .._solver.on_manifold import AbstractStepsOnManifold
from .symplectic_steps import RATTLESteps
from .system import MechanicalSystem


class RATTLE(AbstractStepsOnManifold):
    """The hook around the steps."""

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection = NewtonProjection()

    def prepare_terms(self, terms: Any) -> Any:
        return terms


def rattle(system: MechanicalSystem, *, order: Order = 2) -> RATTLE:
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
        not evaluate the `terms`: a force that is in these alone has no effect. Its constraints are on
        positions; all may depend on `args`.
    - `order`: 2, or compositions of such steps of order 4 (five of them, Suzuki) or 6 (nine, Kahan & Li).

    Where masses depend on positions, or forces on velocities (bodies in space, whose attitude is a unit
    quaternion; most Lagrangians), the steps are those of the variational integrator that
    RATTLE is for constant masses, for rigid bodies a Lie group method. They are implicit, each factors a
    matrix of `n + m` rows, and symplectic if all forces on velocities come from the masses, as gyroscopic ones do; with friction
    or drives they are of the same order and symmetric. A step is to be short beside a turn of a body.

    Rounding errors of positions and velocities are carried from step to step (compensated summation), in
    both precisions. States at the ends of steps are on the manifold to a few units of rounding.

    **Returns:**

    A solver whose gradients, events, resets, ensembles and saved values are as those of [`Projected`][].
    Dense output is of third order between the steps. Steps have a constant size.

    **Raises:**

    `TypeError` for another system, `ValueError` for another order or constraints on velocities; when it is
    solved, `ValueError` for implicit steps with `redundant=True`.

    Prefer an explicit method of high order for short times at tight tolerances.

    Sources: Andersen, J. Comput. Phys. 52 (1983) 24-34; Hairer, Lubich & Wanner, Geometric Numerical
    Integration (2006), sections VII.1.4, V.3 and VIII.5; Wendlandt & Marsden, Physica D 106 (1997) 223-246
    (rigid bodies); Marsden & West, Acta Numerica 10 (2001) 357-514.
    """
    if not isinstance(system, MechanicalSystem):
        raise TypeError(
            f"`system` must be an `mj.MechanicalSystem`, got {type(system).__name__}. Of an assembly of `mj.multibody` "
            "pass its `system`."
        )
    check_order(order)
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
    return RATTLE(RATTLESteps(system, order), system.constraint)
