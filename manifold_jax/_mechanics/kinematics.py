"""Constraints on positions and on velocities, and the mass matrix, as functions of vectors."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike, Y
from .._constraint.residual import jacobian
from .._linalg.rows import AbstractRows, Rows
from .._linalg.sparse import Choice, choose_structure, SparseRows, Structure
from .mass import factorize_mass, InvertedBlocks, Mass, mass_values


class AbstractPositions(eqx.Module):
    """Constraints `phi(t, q, args)` that know a shorter way to their Jacobian than differentiating."""

    @abc.abstractmethod
    def __call__(self, t: RealScalarLike, q: Y, args: Args) -> Any: ...

    @abc.abstractmethod
    def jacobian(self, t: RealScalarLike, q: Y, args: Args) -> Float[Array, "p k"]:
        """Return the Jacobian in the orders of `ravel_pytree` of the residual and of `q`."""


class Kinematics(NamedTuple):
    """The constraints as functions of vectors, `x` for positions and `w` for velocities, each of
    `k` numbers."""

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable
    unravel: Callable
    structure: Choice
    redundant: bool

    @staticmethod
    def of(system: Any, y: Y) -> "Kinematics":
        """Return the kinematics of a mechanical system, or of its constraint, for states like
        `y`."""
        q, _ = check_mechanical_state(y)
        unravel = jfu.ravel_pytree(q)[1]
        return Kinematics(
            system.holonomic,
            system.nonholonomic,
            system.mass_matrix,
            unravel,
            system.structure,
            system.redundant,
        )

    def dense(self) -> "Kinematics":
        """The same, with Jacobians as arrays."""
        return self._replace(structure="dense")

    def flat(self, y: Y) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        q, v = y
        return jfu.ravel_pytree(q)[0], jfu.ravel_pytree(v)[0]

    def position(self, t: Array, x: Float[Array, " k"], args: Args) -> Float[Array, " p"]:
        if self.holonomic is None:
            return jnp.zeros((0,), x.dtype)
        return jfu.ravel_pytree(self.holonomic(t, self.unravel(x), args))[0]

    def velocity(
        self, t: Array, w: Float[Array, " k"], context: tuple[Float[Array, " k"], Args]
    ) -> Float[Array, " m"]:
        """Residual of the velocities at the positions in `context`."""
        x, args = context
        position = lambda t, x: self.position(t, x, args)
        _, rate = jax.jvp(position, (t, x), (jnp.ones_like(t), w))
        if self.nonholonomic is None:
            return rate
        extra = self.nonholonomic(t, self.unravel(x), self.unravel(w), args)
        return jnp.concatenate([rate, jfu.ravel_pytree(extra)[0]])

    def rows(
        self, t: Array, x: Float[Array, " k"], w: Float[Array, " k"], args: Args
    ) -> tuple[Rows, int]:
        """`C = [J; da/dv]`, and how many of the rows belong to positions."""
        if (structure := self.structure_at(t, x, w, args)) is not None:
            p = jax.eval_shape(self.position, t, x, args).size
            if self.nonholonomic is None:
                return SparseRows.of(self.position, t, x, args, structure), p
            return SparseRows.of(self.velocity, t, w, (x, args), structure), p
        if isinstance(self.holonomic, AbstractPositions):
            J = self.holonomic.jacobian(t, self.unravel(x), args)
        else:
            _, J = jacobian(lambda x: self.position(t, x, args), x)
        if self.nonholonomic is None:
            return J, J.shape[0]
        nonholonomic = lambda w: self.velocity(t, w, (x, args))[J.shape[0] :]
        return jnp.concatenate([J, jacobian(nonholonomic, w)[1]]), J.shape[0]

    def position_rows(
        self, t: Array, x: Float[Array, " k"], w: Float[Array, " k"], args: Args, C: Rows, p: int
    ) -> Rows:
        """`J`, the first `p` of the rows `C`."""
        if isinstance(C, AbstractRows):
            of_positions = self._replace(nonholonomic=None)
            return of_positions.rows(t, x, w, args)[0]
        return C[:p]

    def structure_at(
        self, t: Array, x: Float[Array, " k"], w: Float[Array, " k"], args: Args
    ) -> Structure | None:
        """Return the structure of the rows, if they are sparse. Known while tracing."""
        if self.structure == "dense" or self.redundant:
            return None
        equations = []
        if self.holonomic is not None:
            equations.append((lambda x: self.position(t, x, args), x))
        if self.nonholonomic is not None:
            extra = lambda w: self.nonholonomic(t, self.unravel(x), self.unravel(w), args)  # pyright: ignore[reportOptionalCall]
            equations.append((lambda w: jfu.ravel_pytree(extra(w))[0], w))
        mass = jax.eval_shape(lambda: self.mass_values(t, x, w, args))
        return choose_structure(self.structure, tuple(equations), mass.shape)

    def acceleration_bias(
        self, t: Array, x: Float[Array, " k"], w: Float[Array, " k"], args: Args
    ) -> Float[Array, " m"]:
        """What the second derivative of the constraints is at zero acceleration."""
        velocity = lambda t, x: self.velocity(t, w, (x, args))
        return jax.jvp(velocity, (t, x), (jnp.ones_like(t), w))[1]

    def mass(
        self,
        t: Array,
        x: Float[Array, " k"],
        w: Float[Array, " k"],
        args: Args,
        C: Rows,
    ) -> Mass | InvertedBlocks:
        return factorize_mass(self.mass_values(t, x, w, args), C)

    def mass_values(
        self, t: Array, x: Float[Array, " k"], w: Float[Array, " k"], args: Args
    ) -> Float[Array, "..."] | InvertedBlocks:
        q, v = self.unravel(x), self.unravel(w)
        return mass_values(self.mass_matrix(t, q, v, args), q)


def check_mechanical_state(y: Y) -> tuple[Any, Any]:
    """Refuse, while tracing, states that are not `(q, v)`."""
    if not (isinstance(y, tuple) and len(y) == 2):
        raise ValueError(
            "`y` must be the tuple `(q, v)` of positions and velocities of a mechanical system, got shapes "
            f"{jtu.tree_map(jnp.shape, y)}. Write e.g. `y0 = (q0, jnp.zeros_like(q0))`."
        )
    q, v = y
    shapes = lambda tree: jtu.tree_map(jnp.shape, tree)
    if jtu.tree_structure(q) != jtu.tree_structure(v) or shapes(q) != shapes(v):
        raise ValueError(
            f"`y` = (q, v) must have velocities of the same structure and shapes as the positions, v = dq/dt, got "
            f"{shapes(q)} and {shapes(v)}."
        )
    return q, v
