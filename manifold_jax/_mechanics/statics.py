"""Positions in which a mechanism stays at rest."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Float

from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, RealScalarLike, Y
from .system import MechanicalSystem


_MAX_STEPS = 256
_NOT_FOUND = (
    "No equilibrium was found near `q`. Start closer to one, for instance at the end of a motion with damping. A position that is "
    "not isolated (a mechanism that balances anywhere, equations that depend on each other) cannot be found."
)


class Equilibrium(NamedTuple):
    """What [`equilibrium`][manifold_jax.equilibrium] returns: the positions, like `q`, and the multipliers,
    in the order of `multipliers` of [`MechanicalSystem`][]."""

    q: Y
    multipliers: Float[Array, " m"]


@clear_errors
@numbers_as_arrays("args", times=("t",))
@eqx.filter_jit
def equilibrium(
    system: MechanicalSystem,
    q: Y,
    args: Args = None,
    *,
    t: RealScalarLike = 0.0,
    tolerance: float = 1e-12,
) -> Equilibrium:
    r"""Find positions in which a mechanism stays at rest: forces and constraint forces are in balance,

    $$Q(t, q, 0, a) - J(t, q)^T \lambda = 0, \qquad \varphi(t, q, a) = 0.$$

    ```python
    hanging, _ = mj.equilibrium(system, q0, args)
    near = mj.linearize(system.terms, system.constraint, 0.0, (hanging, rest), args)
    frequencies = near.eigenvalues()
    ```

    Stable or not: the nearest root by a dogleg method is found, not the least energy. With derivatives by
    `args` and by the numbers of the system (implicit function theorem), in both modes; also inside `jit`
    and `vmap`.

    **Arguments:**

    - `system`: with position constraints or none, whose equations are independent; no velocity constraints
        and no auxiliary states.
    - `q`: positions near the equilibrium, such as `assembly.state()[0]`. They need not satisfy the
        constraints.
    - `args`: as for the solve. `t`: the time of constraints and forces that depend on it.
    - `tolerance`: relative and absolute, of positions and multipliers.

    **Returns:** an [`Equilibrium`][].

    **Raises** an error at run time if none is found.

    Source: Nocedal & Wright, Numerical Optimization (2006), ch. 11 (dogleg steps for equations); Haug,
    Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 11.
    """
    _check(system)
    x, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.asarray, q))
    still = jnp.zeros_like(x)

    def imbalance(unknowns: Any, given: Any) -> Any:
        """Return `Q - J^T lambda` and the constraints."""
        (x, multipliers), (system, t, args) = unknowns, given
        force = jfu.ravel_pytree(system.force(t, unravel(x), unravel(still), args))[0]
        if system.holonomic is None:
            return force, multipliers
        phi = lambda x: jfu.ravel_pytree(system.holonomic(t, unravel(x), args))[0]
        residual, pullback = jax.vjp(phi, x)
        return force - pullback(multipliers)[0], residual

    start = x, jax.lax.stop_gradient(system.multipliers(t, (q, unravel(still)), args))
    solver = optx.Dogleg(tolerance, tolerance)
    given = system, t, args
    found = optx.root_find(imbalance, solver, start, given, max_steps=_MAX_STEPS, throw=False)
    failed = found.result != optx.RESULTS.successful
    x, multipliers = eqx.error_if(found.value, failed, _NOT_FOUND)
    return Equilibrium(unravel(x), multipliers)


def _check(system: Any) -> None:
    if not isinstance(system, MechanicalSystem):
        raise TypeError(
            f"`system` must be an `mj.MechanicalSystem`, such as `assembly.system`, got {type(system).__name__}."
        )
    if system.nonholonomic is not None or system.auxiliary is not None:
        raise ValueError(
            "`system` must have neither velocity constraints nor auxiliary states: what is at rest then depends on more than "
            "the positions."
        )
    if system.redundant:
        raise ValueError(
            "`system` has `redundant=True`, so that its multipliers are not determined. Of an assembly take "
            "`assembly.without_dependent_equations().system`, otherwise remove the dependent equations."
        )
