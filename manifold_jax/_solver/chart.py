r"""Local coordinates on the manifold around a point `c` (the paper's parameterization approach).

With directions `V` across the manifold (shape `(n, m)`, `G(c) V` nonsingular) every point near `c` is

    x = lift(w) = w + V z,     g(t, w + V z) = 0,

and all `w` that differ by an element of `range(V)` have the same `x`: the coordinates of `x` are `w`
modulo `range(V)`. A Runge-Kutta method is linear in the stages, so it can compute with any
representative `w` and needs no basis of the coordinate space. The tangent space chart is
`V = W^-1 G(c)^T`; a partition into dependent and independent coordinates is `V = D G(c)^T` with the 0-1
matrix `D` that selects the dependent ones.

Source: Rheinboldt, Math. Comp. 43 (1984) 473-482; Wehage & Haug, J. Mech. Design 104 (1982) 247-255;
Potra & Rheinboldt, Mech. Struct. Mach. 19 (1991) 1-18.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.projection_info import ProjectionInfo
from .._constraint.settings import NewtonProjection
from .._linalg.rows import combine


class AbstractCoordinates(eqx.Module):
    """Coordinates `w` near one point of the manifold, the one at which a step begins.

    `w`, a pytree of arrays of any shapes, is what the solver advances: `w' = pull_back(f(t, y))` at
    `y = lift(w)`, starting from `origin`. Times are true times. All methods are traced, for one
    trajectory, and must be differentiable. The order of the solver is preserved if `lift` and
    `pull_back` are consistent: `d lift(w) / dt = f` for `w' = pull_back(f)`, up to directions on which
    `lift` does not depend.
    """

    origin: eqx.AbstractVar[Y]  # the coordinates of the point itself

    @abc.abstractmethod
    def lift(self, t: RealScalarLike, w: Y, args: Args) -> tuple[Y, ProjectionInfo]:
        """Return the point of the manifold with these coordinates at time `t`. `info.success` is false
        where there is none; its derivative must be finite there, too."""

    @abc.abstractmethod
    def pull_back(self, t: RealScalarLike, w: Y, y: Y, vector: Y) -> Y:
        """Return the velocity of the coordinates, like `w`, that belongs to a velocity `vector` of the
        state at `y = lift(w)`. Linear in `vector`, which is tangent."""

    @abc.abstractmethod
    def push_forward(self, t: RealScalarLike, w: Y, y: Y, args: Args, error: Y) -> Y:
        """Return the error of the state `y = lift(w)`, like `y`, that belongs to an error of the
        coordinates: the derivative of the lift. Tolerances are those of the state."""


class AbstractChart(eqx.Module):
    """Local coordinates for [`LocalCoordinates`][], constructed at the beginning of each step.

    Implementations provide `at`. If coordinates are not themselves states near the manifold, they also
    provide `state`. It may only need arrays of the state and of the constraint: dense output stores the
    coordinates and the states at the beginnings of steps.
    """

    @abc.abstractmethod
    def at(
        self,
        constraint: AbstractConstraint,
        projection: NewtonProjection,
        t: RealScalarLike,
        y: Y,
        args: Args,
    ) -> AbstractCoordinates:
        """Return coordinates around the point `y` of the manifold at the true time `t`."""

    def check(self, constraint: AbstractConstraint) -> None:
        """Raise `ValueError` for constraints that have no such coordinates."""
        del constraint

    @property
    def state(self) -> Callable[[Y, Y], Y] | None:
        """`state(y, w)`: a state near the one with coordinates `w` around `y`, for dense output, which
        is then corrected. `None` if that is `w` itself."""
        return None


def check_state_like(chart: AbstractChart, origin: Y, y: Y) -> None:
    """Refuse coordinates that are not like the state, if the chart takes them for states."""
    shapes = lambda tree: [jnp.shape(leaf) for leaf in jtu.tree_leaves(tree)]
    if jtu.tree_structure(origin) == jtu.tree_structure(y) and shapes(origin) == shapes(y):
        return
    raise ValueError(
        f"`chart={type(chart).__name__}` has coordinates of shape {jtu.tree_map(jnp.shape, origin)} for a state of shape "
        f"{jtu.tree_map(jnp.shape, y)}, which are not states themselves: give the chart a property `state` that returns a "
        "function `(y, w)`, the state near the one with coordinates `w` around `y`."
    )


class _Representatives(AbstractCoordinates):
    """States modulo the range of the directions."""

    constraint: AbstractConstraint
    projection: NewtonProjection
    directions: Float[Array, "m k"]
    origin: Y

    def lift(self, t, w, args) -> tuple[Y, ProjectionInfo]:
        correct = self.constraint.correct
        return correct(
            self.projection, t, w, args, fallback=self.origin, directions=self.directions
        )

    def pull_back(self, t, w, y, vector) -> Y:
        return vector

    def push_forward(self, t, w, y, args, error) -> Y:
        return self.constraint.push_forward(t, y, args, self.directions, error)


class TangentSpaceChart(AbstractChart):
    """Coordinates in the tangent space at the beginning of each step; the manifold is reached
    along its normals there, `V = W^-1 G^T`.

    Source: Rheinboldt, Math. Comp. 43 (1984) 473-482.
    """

    def at(self, constraint, projection, t, y, args) -> AbstractCoordinates:
        directions = constraint.normals(projection, t, y, args).directions
        return _Representatives(
            constraint=constraint, projection=projection, directions=directions, origin=y
        )

    def check(self, constraint: AbstractConstraint) -> None:
        _refuse_redundant(constraint)


class CoordinatePartitionChart(AbstractChart):
    """Some of the state's own components as coordinates, the others dependent on them.

    The `m` dependent ones are chosen anew at every step, by elimination with column pivoting.
    Prefer [`TangentSpaceChart`][]: partitions need more steps and amplify errors where the
    dependence is ill-conditioned.

    Source: Wehage & Haug, J. Mech. Design 104 (1982) 247-255 (generalized coordinate partitioning).
    """

    def at(self, constraint, projection, t, y, args) -> AbstractCoordinates:
        G = constraint.normals(projection, t, y, args).jacobian
        directions = G * dependent_coordinates(G)[None, :]
        return _Representatives(
            constraint=constraint, projection=projection, directions=directions, origin=y
        )

    def check(self, constraint: AbstractConstraint) -> None:
        _refuse_redundant(constraint)


def _refuse_redundant(constraint: AbstractConstraint) -> None:
    if constraint.redundant:
        raise ValueError(
            "`constraint` is redundant: equations that depend on each other define no local coordinates. "
            "Remove the dependent ones, or use `mj.Projected(solver, constraint)`."
        )


def dependent_coordinates(G: Float[Array, "m n"]) -> Float[Array, " n"]:
    """Return 1 for the `m` columns that a QR decomposition with column pivoting takes first, else 0."""
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
