"""The manifold of a reduced system."""

from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._constraint import AbstractConstraint
from .._custom_types import Args, BoolScalar, RealScalarLike, Y
from .._residual import as_time
from .closing import Closing, Static
from .derivatives import total_derivatives
from .equations import Equations
from .picking import pick


_SINGULAR = (
    "The equations of `F` do not determine all derivatives at `{y}`: some of them depend on the others there "
    "(redundant), or `{y}` is a singular configuration. `dae.consistent_state`, called outside of `jit`, says which."
)


class Reduced(eqx.Module):
    """Equations with the plan of their reduction, all that the parts of a system share."""

    equations: Equations
    static: Static = eqx.field(static=True)

    def closing(self, t: Any, z: Array, args: Args) -> Closing:
        return Closing(self.equations, as_time(t, z.dtype), z, args, self.static)


class ReducedConstraint(AbstractConstraint):
    """`F_i = 0, F_i' = 0, ..., F_i^(c_i - 1) = 0`: what the equations and their derivatives say
    of the state alone. Lower derivatives first. Built by `reduce_dae`."""

    system: Reduced
    differentiations: "tuple[int, ...] | None" = eqx.field(static=True, default=None)  # if not all
    redundant: bool = eqx.field(static=True, default=False)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Float[Array, " m"]:
        c = self.differentiations
        c = self.system.static.plan.layout.structure.c if c is None else c
        return hidden_constraints(self.system, t, y, args, np.zeros(len(c), int), np.asarray(c))

    def faults(self, t, y, args=None) -> tuple[tuple[BoolScalar, str], ...]:
        closing = self.system.closing(t, jfu.ravel_pytree(y)[0], args)
        return ((~closing.linearize(closing.z).full_rank, _SINGULAR),)


def hidden_constraints(
    system: Reduced, t: Any, z: Array, args: Args, first: np.ndarray, end: np.ndarray
) -> Float[Array, " m"]:
    """`F_i^(k)` for `first_i <= k < end_i`."""
    plan, t = system.static.plan, as_time(t, z.dtype)
    rows, order = plan.layout.aliases.rows, int(end.max(initial=0)) - 1
    if order < 0:
        return jnp.zeros((0,), z.dtype)
    jets = plan.jets(z, None, order)
    levels = total_derivatives(system.equations, t, jets, args, order)
    parts = [pick(levels[k], rows[(first <= k) & (k < end)]) for k in range(order + 1)]
    return jnp.concatenate(parts)


def leading_derivatives(system: Reduced, t: Any, z: Array, args: Args) -> Float[Array, " n"]:
    return system.closing(t, z, args).solve()


def rate(system: Reduced, t: Any, z: Array, args: Args) -> Float[Array, " a"]:
    """The vector field."""
    return system.static.plan.layout.rate()(z, leading_derivatives(system, t, z, args))


def unknowns_with_derivatives(
    system: Reduced, t: Any, z: Array, args: Args, number: int
) -> list[Float[Array, " n"]]:
    """`x, x', ...` up to that derivative; those that are not in the equations by differentiating
    along the solution."""
    t = as_time(t, z.dtype)

    def x(t: Array, z: Array) -> Array:
        return system.static.plan.layout.jet(0)(z, leading_derivatives(system, t, z, args))

    found, functions = [], x
    for _ in range(number):
        found.append(functions(t, z))
        functions = _along_solution(system, functions, args)
    return [*found, functions(t, z)]


def _along_solution(system: Reduced, function: Any, args: Args) -> Any:
    def derivative(t: Array, z: Array) -> Array:
        return jax.jvp(function, (t, z), (jnp.ones_like(t), rate(system, t, z, args)))[1]

    return derivative
