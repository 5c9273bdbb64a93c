"""The manifold of a reduced system."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, RealScalarLike, Y
from .._constraint.checks import check_state
from .._constraint.constraint import AbstractConstraint
from .._constraint.residual import as_time
from .._linalg.newton import implicit_root
from .derivatives import pick, total_derivatives
from .equations import Equations
from .highest_derivatives import HighestDerivatives, Static


_SINGULAR = (
    "The equations of `F` do not determine all derivatives at `{y}`: some of them depend on the others there "
    "(redundant), or `{y}` is a singular configuration. `dae.consistent_state`, called outside of `jit`, says which."
)


class Reduced(eqx.Module):
    """Equations with the plan of their reduction, all that the parts of a system share."""

    equations: Equations
    static: Static = eqx.field(static=True)

    def closing(self, t: Any, z: Array, args: Args) -> HighestDerivatives:
        return HighestDerivatives(self.equations, as_time(t, z.dtype), z, args, self.static)

    def split(self, y: Y) -> tuple[Array, Array | None]:
        """The state `z`, and the leading derivatives where they belong to it."""
        self.check(y)
        if not self.static.plan.implicit:
            return y, None
        states = self.static.plan.layout.num_states
        return y[:states], y[states:]

    def check(self, y: Any) -> None:
        """Refuse what is no state, such as the unknowns of the user's equations."""
        check_state(y, "z")
        plan = self.static.plan
        size = plan.layout.num_states + len(plan.layout.structure.d) * plan.implicit
        if eqx.is_array_like(y) and jnp.shape(y) == (size,):
            return
        raise ValueError(
            f"The state of a reduced system is one vector of shape ({size},), with the names in `dae.report.states`; "
            f"got {jtu.tree_map(jnp.shape, y)}. `dae.consistent_state` makes one from a guess of x; of many states "
            "take `jax.vmap`."
        )


class ReducedConstraint(AbstractConstraint):
    """`F_i = 0, F_i' = 0, ..., F_i^(c_i - 1) = 0`: what the equations and their derivatives say
    of the state alone. Lower derivatives first. Built by `reduce_dae`."""

    system: Reduced
    redundant: bool = eqx.field(static=True, default=False)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Float[Array, " m"]:
        c = self.system.static.plan.layout.structure.c
        z, w = self.system.split(y)
        return hidden_constraints(self.system, t, z, args, np.zeros_like(c), c, w)

    def faults(self, t, y, args=None) -> tuple[tuple[BoolScalar, str], ...]:
        z, w = self.system.split(jfu.ravel_pytree(y)[0])
        closing = self.system.closing(t, z, args)
        return ((~closing.linearize(z if w is None else w).full_rank, _SINGULAR),)


def hidden_constraints(
    system: Reduced,
    t: Any,
    z: Array,
    args: Args,
    first: np.ndarray,
    end: np.ndarray,
    w: Array | None = None,
) -> Float[Array, " m"]:
    """`F_i^(k)` for `first_i <= k < end_i`. Leading derivatives `w` like those that belong to `z` are
    for the size of what cancels in combinations of equations. Without these the example serves better:
    there all that these equations do not depend on is known to be finite, with its slopes."""
    plan, t = system.static.plan, as_time(t, z.dtype)
    rows, order = plan.layout.aliases.rows, int(end.max(initial=0)) - 1
    if order < 0:
        return jnp.zeros((0,), z.dtype)
    jets = plan.jets_of_states(z, w if system.equations.combinations else None, order)
    levels = total_derivatives(system.equations, t, jets, args, order)
    parts = [pick(levels[k], rows[(first <= k) & (k < end)]) for k in range(order + 1)]
    return jnp.concatenate(parts)


def rate(system: Reduced, t: Any, z: Array, args: Args) -> Float[Array, " a"]:
    """The vector field."""
    return system.static.plan.layout.rate()(z, system.closing(t, z, args).solve())


def unknowns_with_derivatives(
    system: Reduced, t: Any, y: Array, args: Args, number: int
) -> list[Float[Array, " n"]]:
    """`x, x', ...` up to that derivative, by differentiating along the solution."""
    layout = system.static.plan.layout
    z, w = system.split(y)
    w = system.closing(t, z, args).solve() if w is None else w

    def leading(t: Array, z: Array) -> Array:
        """Solved for only once: nearby, the same as the function that the equations define."""
        return implicit_root(system.closing(t, z, args), w)

    def differentiated(function: Callable) -> Callable:
        return lambda t, z: jax.jvp(
            function, (t, z), (jnp.ones_like(t), layout.rate()(z, leading(t, z)))
        )[1]

    further = layout.most_beyond(number)
    t, function, found = as_time(t, z.dtype), leading, []
    for _ in range(further + 1):
        found.append(function(t, z))
        function = differentiated(function)
    known = jnp.concatenate(found)
    return [layout.jet(k, further)(z, known) for k in range(number + 1)]
