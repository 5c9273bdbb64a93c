"""Newton's method for square systems, and the derivative of their roots.

`r(z) = residual(point(z))` with unknowns `z` and the point to which they belong. Vectors only.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.derivative_rule import ForwardRule
from .._base.types import BoolScalar, FloatScalar, IntScalar
from .dense import Factorization
from .pivoted import factorize_equilibrated


@runtime_checkable
class LinearizedAtPoint(Protocol):
    """The matrix `dr/dz`, factored."""

    def solve(self, b: Float[Array, " m"]) -> Float[Array, " m"]: ...


class AbstractEquations(eqx.Module):
    """`m` equations in `m` unknowns. All arrays that a root depends on are leaves."""

    @abc.abstractmethod
    def point(self, z: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return the point that belongs to the unknowns."""

    @abc.abstractmethod
    def residual(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return the residual at a point."""

    @abc.abstractmethod
    def linearize(self, x: Float[Array, " n"]) -> LinearizedAtPoint:
        """Return the derivative of the residual with respect to the unknowns, at a point."""

    def place_after(
        self, place: Float[Array, " n"], z: Float[Array, " m"], dz: Float[Array, " m"]
    ) -> Float[Array, " n"]:
        """Return the place that belongs to `z + dz`, where `place` belongs to `z`. It is the point itself, or what the
        point is found from."""
        del place
        return self.point(z + dz)

    def point_at(self, place: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the point of a place."""
        return place


class SquareSystem(AbstractEquations):
    """`function(z) = 0` for vectors; the function is a pytree."""

    function: Callable

    def point(self, z: Float[Array, " m"]) -> Float[Array, " m"]:
        return z

    def residual(self, x: Float[Array, " m"]) -> Float[Array, " m"]:
        return self.function(x)

    def linearize(self, x: Float[Array, " m"]) -> Factorization:
        return factorize_equilibrated(jax.jacfwd(self.function)(x))


class Iterate(NamedTuple):
    """The unknowns, their place and residual, and the state of the iteration."""

    z: Float[Array, " m"]
    place: Float[Array, " n"]
    r: Float[Array, " m"]
    scaled_residual: FloatScalar  # max_i |r_i| / scale_i
    iterations: IntScalar
    progress: BoolScalar  # whether the last iteration lowered the residual


class _Search(NamedTuple):
    """Equations with the scale of each residual."""

    equations: AbstractEquations
    scale: Float[Array, " m"]

    def after(
        self, z: Float[Array, " m"], place: Float[Array, " n"], dz: Float[Array, " m"]
    ) -> tuple:
        """Return the first four fields of the iterate at `z + dz`."""
        place = self.equations.place_after(place, z, dz)
        r = self.equations.residual(self.equations.point_at(place))
        return z + dz, place, r, self.scaled(r)

    def scaled(self, r: Float[Array, " m"]) -> FloatScalar:
        return jnp.max(jnp.abs(r) / self.scale, initial=0)

    def lowered(self, state: Iterate, dz: Float[Array, " m"]) -> Iterate:
        """Return the step to `z - dz` if it lowers the residual, else the state as it was."""
        following = self.after(state.z, state.place, -dz)
        progress = following[-1] < state.scaled_residual
        best = jtu.tree_map(lambda new, old: jnp.where(progress, new, old), following, state[:4])
        return Iterate(*best, state.iterations + 1, progress)  # pyright: ignore[reportCallIssue]


# Scaled residual, in units of rounding, at which iterations end. With 4 units the circle of the paper's
# Example 2.1 is left by up to 1.8e-15, with half a unit by 4.4e-16.
_ROUNDING = 0.5


# Largest number of equations for which iterations are written out. For more of them the loop runs as
# fast and compiles in less time.
_WRITTEN_OUT = 2


def chord(
    equations: AbstractEquations,
    linearization: LinearizedAtPoint,
    z: Float[Array, " m"],
    place: Float[Array, " n"],
    r: Float[Array, " m"],
    scale: Float[Array, " m"],
    max_steps: int,
) -> Iterate:
    """Simplified Newton iteration from `z` at a place with residual `r`, with a single factorization. Two
    iterations are nearly always enough; for few equations they are written out, so that they fuse with
    the surrounding operations.

    A point that is a root to rounding stays where it is: a correction of that size is large for a
    component that is small.
    """
    search = _Search(equations, scale)
    written_out = min(2, max_steps) if r.size <= _WRITTEN_OUT else 0
    rounding = _ROUNDING * jnp.finfo(r.dtype).eps
    scaled_residual = search.scaled(r)
    needed = scaled_residual > rounding
    for _ in range(written_out):
        dz = jnp.where(needed, -linearization.solve(r), 0)
        z, place, r, scaled_residual = search.after(z, place, dz)
    return jax.lax.while_loop(
        lambda s: (s.scaled_residual > rounding) & s.progress & (s.iterations < max_steps),
        lambda s: search.lowered(s, linearization.solve(s.r)),
        Iterate(
            z, place, r, scaled_residual, jnp.asarray(written_out, jnp.int32), jnp.asarray(True)
        ),
    )


def damped_newton(
    equations: AbstractEquations,
    z: Float[Array, " m"],
    place: Float[Array, " n"],
    r: Float[Array, " m"],
    scale: Float[Array, " m"],
    max_steps: int,
    tolerance: Any,
) -> Iterate:
    """Newton's method with a new Jacobian in every iteration, and a quarter of the step while the
    residual grows, unless it is below `tolerance` already."""
    search = _Search(equations, scale)

    def unfinished(carry: tuple[Iterate, FloatScalar]) -> BoolScalar:
        s, _ = carry
        stalled = ~s.progress & (s.scaled_residual <= tolerance)
        rounded = s.scaled_residual <= _ROUNDING * jnp.finfo(r.dtype).eps
        return ~rounded & ~stalled & (s.iterations < max_steps)

    def advance(carry: tuple[Iterate, FloatScalar]) -> tuple[Iterate, FloatScalar]:
        s, damping = carry
        dz = equations.linearize(equations.point_at(s.place)).solve(s.r)
        s = search.lowered(s, damping * dz)
        return s, jnp.where(s.progress, jnp.ones_like(damping), damping / 4)

    start = Iterate(z, place, r, search.scaled(r), jnp.zeros((), jnp.int32), jnp.asarray(True))
    return jax.lax.while_loop(unfinished, advance, (start, jnp.ones_like(start.scaled_residual)))[0]


def find_root(
    equations: AbstractEquations,
    guess: Float[Array, " m"],
    max_steps: int = 50,
    tolerance: Any = jnp.inf,
) -> Float[Array, " m"]:
    """Return the best unknowns found, by `max_i |r_i|`, without their derivative. Simple roots are
    found to rounding. Ends where no step lowers a residual that is below the tolerance."""
    equations, guess = without_derivative((equations, guess))
    x = equations.point(guess)
    r = equations.residual(x)
    return damped_newton(equations, guess, x, r, jnp.ones_like(r), max_steps, tolerance).z


class ImplicitTangent(NamedTuple):
    """Tangents of a root and of its point at fixed unknowns, and the linearization at the root."""

    dz: Float[Array, " m"]
    moved: Float[Array, " n"]
    linearization: LinearizedAtPoint


def implicit_tangent(
    equations: AbstractEquations, tangent: Any, z: Float[Array, " m"]
) -> ImplicitTangent:
    """Return the derivative of the root `z` along `tangent`, a tangent of the leaves of `equations`:

        r(z, theta) = 0:  dz = -(dr/dz)^-1 (dr/dtheta) dtheta.

    It does not depend on how the root was found, and can itself be differentiated.
    """
    point, moved = _derivative(lambda e: e.point(z), equations, tangent)
    along = lambda both: both[0].residual(both[1])
    _, slope = _derivative(along, (equations, point), (tangent, moved))
    linearization = equations.linearize(point)
    return ImplicitTangent(-linearization.solve(slope), moved, linearization)


def _derivative(f: Callable, x: Any, tangent: Any) -> tuple[Array, Array]:
    value, slope = eqx.filter_jvp(f, (x,), (tangent,))
    return value, jnp.zeros_like(value) if slope is None else slope


@ForwardRule
def implicit_root(equations: AbstractEquations, root: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return `root` as a function of the leaves of `equations`, which define it."""
    del equations
    return root


@implicit_root.define_jvp
def _implicit_root_jvp(root, primals, tangents):
    (equations, _), (moved, _) = primals, tangents
    return implicit_tangent(equations, moved, root).dz


@ForwardRule
def root_of_step(step: Callable[[Array], Array], root: Array) -> Array:
    """Return `root` as a function of the leaves of `step`: `step(x)` is Newton's step `-A^-1 r` at `x`,
    whose derivative at a root is that of the root."""
    del step
    return root


@root_of_step.define_jvp
def _root_of_step_jvp(root, primals, tangents):
    (step, _), (moved, _) = primals, tangents
    return _derivative(lambda step: step(root), step, moved)[1]


def without_derivative(tree: Any) -> Any:
    """Return `tree` with all its arrays held fixed."""
    return jtu.tree_map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, tree)
