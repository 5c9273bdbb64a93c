"""Constraints on positions and on velocities, and the mass matrix, as functions of vectors."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.shapes import are_alike, shapes
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import call_traced_once
from .._constraint.residual import as_time, jacobian
from .._linalg.dense import is_rounding
from .._linalg.rows import AbstractRows, Rows
from .._linalg.sparse import Choice, choose_structure, SparseRows, Structure
from .mass import factorize_mass, InvertedBlocks, Mass, mass_values


Vector: TypeAlias = Float[Array, " k"]


class AbstractPositions(eqx.Module):
    """Constraints `phi(t, q, args)` with a faster way to their Jacobian than differentiation."""

    @abc.abstractmethod
    def __call__(self, t: RealScalarLike, q: Y, args: Args) -> Any: ...

    @abc.abstractmethod
    def jacobian(self, t: RealScalarLike, q: Y, args: Args) -> Float[Array, "p k"]:
        """Return the Jacobian in the orders of `ravel_pytree` of the residual and of `q`."""


class AbstractPositionsWithBias(AbstractPositions):
    """The same with a faster way to their second time derivative, too."""

    @abc.abstractmethod
    def bias(self, t: RealScalarLike, q: Y, v: Y, args: Args) -> Float[Array, " p"]:
        """Return the second time derivative of the residual for `dv/dt = 0`."""


class Kinematics(NamedTuple):
    """The constraints of a mechanical system at one state, as functions of vectors of `k` numbers, `x`
    for positions and `w` for velocities, and its mass matrix there."""

    system: Any  # or its constraint
    nonholonomic: Callable | None
    structure: Choice
    unravel: Callable
    t: Array
    x: Vector
    w: Vector
    args: Args

    @staticmethod
    def of(system: Any, t: RealScalarLike, y: Y, args: Args) -> "Kinematics":
        _check_mechanical_state(y)
        x, w = flat(y)
        fields = system.nonholonomic, system.structure, jfu.ravel_pytree(y[0])[1]
        return Kinematics(system, *fields, as_time(t, x.dtype), x, w, args)

    def dense(self) -> "Kinematics":
        """Return the same with Jacobians as arrays."""
        return self._replace(structure="dense")

    def position(self, t: Array, x: Vector, args: Args) -> Float[Array, " p"]:
        if self.system.holonomic is None:
            return jnp.zeros((0,), x.dtype)
        phi = call_traced_once(self.system.holonomic, t, self.unravel(x), args)
        return jfu.ravel_pytree(phi)[0]

    def velocity(self, t: Array, w: Vector, context: tuple[Vector, Args]) -> Float[Array, " m"]:
        """Return the residual of the velocities at the positions in `context`."""
        x, args = context
        position = lambda t, x: self.position(t, x, args)
        _, rate = jax.jvp(position, (t, x), (jnp.ones_like(t), w))
        if self.nonholonomic is None:
            return rate
        return jnp.concatenate([rate, self._nonholonomic(t, w, context)])

    def _nonholonomic(self, t: Array, w: Vector, context: tuple[Vector, Args]) -> Array:
        x, args = context
        assert self.nonholonomic is not None
        a = call_traced_once(self.nonholonomic, t, self.unravel(x), self.unravel(w), args)
        return jfu.ravel_pytree(a)[0]

    def positions(self) -> Float[Array, " p"]:
        return self.position(self.t, self.x, self.args)

    def velocities(self) -> Float[Array, " m"]:
        return self.velocity(self.t, self.w, (self.x, self.args))

    def acceleration_bias(self) -> Float[Array, " m"]:
        """Return the second time derivative of the constraints at zero acceleration."""
        holonomic = self.system.holonomic
        if isinstance(holonomic, AbstractPositionsWithBias) and self.nonholonomic is None:
            return holonomic.bias(self.t, self.unravel(self.x), self.unravel(self.w), self.args)
        velocity = lambda t, x: self.velocity(t, self.w, (x, self.args))
        return jax.jvp(velocity, (self.t, self.x), (jnp.ones_like(self.t), self.w))[1]

    def rows(self) -> tuple[Rows, int]:
        """Return `C = [J; da/dv]`, and how many of its rows belong to positions. Those of redundant equations
        that are rounding are zero: of equations that hold identically."""
        t, x, w, args = self.t, self.x, self.w, self.args
        if (structure := self.structure_here()) is not None:
            p = jax.eval_shape(self.position, t, x, args).size
            if self.nonholonomic is None:
                return SparseRows.of(self.position, t, x, args, structure), p
            return SparseRows.of(self.velocity, t, w, (x, args), structure), p
        if isinstance(self.system.holonomic, AbstractPositions):
            J = self.system.holonomic.jacobian(t, self.unravel(x), args)
        else:
            _, J = jacobian(lambda x: self.position(t, x, args), x)
        C = J
        if self.nonholonomic is not None:
            nonholonomic = lambda w: self.velocity(t, w, (x, args))[J.shape[0] :]
            C = jnp.concatenate([J, jacobian(nonholonomic, w)[1]])
        if self.system.redundant:
            C = jnp.where(is_rounding(jnp.max(jnp.abs(C), axis=1))[:, None], 0, C)
        return C, J.shape[0]

    def position_rows(self, C: Rows, p: int) -> Rows:
        """Return `J`, the first `p` of the rows `C`."""
        if isinstance(C, AbstractRows):
            return self._replace(nonholonomic=None).rows()[0]
        return C[:p]

    def structure_here(self) -> Structure | None:
        """Return the structure of the rows, if they are sparse. Known while tracing."""
        t, args, equations = self.t, self.args, []
        if self.structure == "dense" or self.system.redundant:
            return None
        if self.system.holonomic is not None:
            equations.append((lambda x: self.position(t, x, args), self.x))
        if self.nonholonomic is not None:
            equations.append((lambda w: self._nonholonomic(t, w, (self.x, args)), self.w))
        mass = jax.eval_shape(self.mass_values)
        return choose_structure(self.structure, tuple(equations), mass.shape)

    def mass(self, C: Rows) -> Mass | InvertedBlocks:
        return factorize_mass(self.mass_values(), C)

    def mass_values(self) -> Float[Array, "..."] | InvertedBlocks:
        q, v = self.unravel(self.x), self.unravel(self.w)
        return mass_values(call_traced_once(self.system.mass_matrix, self.t, q, v, self.args), q)


def flat(y: Y) -> tuple[Vector, Vector]:
    """Return positions and velocities as vectors."""
    q, v = y
    return jfu.ravel_pytree(q)[0], jfu.ravel_pytree(v)[0]


def _check_mechanical_state(y: Y) -> None:
    """Refuse, while tracing, states that are not `(q, v)`."""
    if not (isinstance(y, tuple) and len(y) == 2):
        raise ValueError(
            "`y` must be the tuple `(q, v)` of positions and velocities of a mechanical system, got shapes "
            f"{shapes(y)}. Write e.g. `y0 = (q0, jnp.zeros_like(q0))`."
        )
    q, v = y
    if not are_alike(q, v):
        raise ValueError(
            f"`y` = (q, v) must have velocities of the same structure and shapes as the positions, v = dq/dt, got "
            f"{shapes(q)} and {shapes(v)}."
        )
