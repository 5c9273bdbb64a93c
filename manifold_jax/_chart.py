r"""Local coordinates on the manifold around a point `c` (the paper's parameterization approach).

With directions `V` across the manifold (shape `(n, m)`, `G(c) V` regular) every point near `c` is

    x = lift(w) = w + V z,     g(t, w + V z) = 0,

and all `w` that differ by a multiple of `V` have the same `x`: the coordinates of `x` are `w`
modulo the span of `V`. A Runge-Kutta method is linear in the stages, so that it may as well
compute with any representative `w`: it needs no basis of the coordinate space. The tangent
space chart is `V = W^-1 G(c)^T`; a partition into dependent and independent coordinates is
`V = D G(c)^T` with the 0-1 matrix `D` that selects the dependent ones.

Source: Rheinboldt, Math. Comp. 43 (1984) 473-482; Wehage & Haug, J. Mech. Design 104 (1982)
247-255; Potra & Rheinboldt, Mech. Struct. Mach. 19 (1991) 1-18.
"""

import abc

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._constraint import AbstractConstraint, jacobian, residual_vector
from ._custom_types import Args, RealScalarLike, Y
from ._linear import combine, factorize, gram
from ._mechanics import MechanicalConstraint
from ._mechanics.constraint import Kinematics
from ._projection import NewtonProjection


class AbstractChart(eqx.Module):
    """How the directions `V` of a chart are chosen."""

    @abc.abstractmethod
    def directions(
        self,
        projection: NewtonProjection,
        constraint: AbstractConstraint,
        t: RealScalarLike,
        y: Y,
        args: Args,
    ) -> Float[Array, "m n"]:
        """`V^T` at the point `y`."""


class TangentSpaceChart(AbstractChart):
    """Coordinates in the tangent space at the beginning of each step; the manifold is reached
    along its normals there, `V = W^-1 G^T`.

    Source: Rheinboldt, Math. Comp. 43 (1984) 473-482.
    """

    def directions(self, projection, constraint, t, y, args) -> Float[Array, "m n"]:
        return projection.correction_directions(constraint, t, y, args)[1]


class CoordinatePartitionChart(AbstractChart):
    """Some of the state's own components as coordinates, the others dependent on them.

    The `m` dependent ones are chosen anew at every step, by elimination with column pivoting.
    Prefer [`TangentSpaceChart`][]: partitions need more steps and amplify errors where the
    dependence is ill-conditioned.

    Source: Wehage & Haug, J. Mech. Design 104 (1982) 247-255 (generalized coordinate
    partitioning).
    """

    def directions(self, projection, constraint, t, y, args) -> Float[Array, "m n"]:
        G, _ = projection.correction_directions(constraint, t, y, args)
        return G * dependent_coordinates(G)[None, :]


def dependent_coordinates(G: Float[Array, "m n"]) -> Float[Array, " n"]:
    """1 for the `m` columns that a QR decomposition with column pivoting takes first, else 0."""
    G = jax.lax.stop_gradient(G)
    size = jnp.max(jnp.abs(G), axis=1, keepdims=True)
    rest = G / jnp.where(size > 0, size, 1)
    chosen = jnp.zeros(G.shape[1], G.dtype)
    for _ in range(G.shape[0]):
        norms = jnp.where(chosen > 0, -1, jnp.sum(rest**2, axis=0))
        pivot = jnp.arange(G.shape[1]) == jnp.argmax(norms)
        chosen = jnp.where(pivot, 1, chosen)
        column = jnp.sum(jnp.where(pivot, rest, 0), axis=1)
        length = jnp.sum(column**2)
        column = column / jnp.sqrt(jnp.where(length > 0, length, 1))
        rest = rest - column[:, None] * combine(column, rest)[None, :]
    return chosen


def push_forward(
    constraint: AbstractConstraint,
    t: RealScalarLike,
    y: Y,
    args: Args,
    directions: Float[Array, "m n"],
    vector: Y,
) -> Y:
    """The derivative of the lift at `y` on the manifold, `e - V (G V)^-1 G e`.

    Applied to an error estimate of the coordinates it gives that of the state, so that the
    step size controller's tolerances mean what they say.

    Source: Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193 (error tolerances of the
    local coordinates).
    """
    t = jnp.asarray(t)
    e, unravel = jfu.ravel_pytree(vector)
    if isinstance(constraint, MechanicalConstraint):
        return _push_forward_mechanics(constraint, t, y, args, directions, vector)
    x, unravel_state = jfu.ravel_pytree(y)
    residual = lambda x: residual_vector(constraint, t, unravel_state(x), args)
    _, G = jacobian(residual, x)
    return unravel(_without_normal_part(G, directions, e, combine(e, G.T)))


def _push_forward_mechanics(constraint, t, y, args, directions, vector):
    """Positions first; the velocities depend on them."""
    equations = Kinematics(constraint, y)
    x, w = equations.flat(y)
    e_x, e_w = equations.flat(vector)
    C, p = equations.rows(t, x, w, args)
    if p > 0:
        e_x = _without_normal_part(C[:p], directions[:p], e_x, combine(e_x, C[:p].T))
    velocity = lambda x, w: equations.velocity(t, w, (x, args))
    _, rate = jax.jvp(velocity, (x, w), (e_x, e_w))
    e_w = _without_normal_part(C, directions, e_w, rate)
    return equations.unravel(e_x), equations.unravel(e_w)


def _without_normal_part(
    G: Float[Array, "m n"],
    directions: Float[Array, "m n"],
    e: Float[Array, " n"],
    rate: Float[Array, " m"],
) -> Float[Array, " n"]:
    return e - combine(factorize(gram(G, directions)).solve(rate), directions)
