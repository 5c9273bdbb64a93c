"""The manifold of a mechanical system: constraints on positions and on velocities."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._constraint import AbstractConstraint, jacobian
from .._custom_types import Args, BoolScalar, RealScalarLike, Y
from .mass import factorize_mass, Mass, mass_values


class MechanicalConstraint(AbstractConstraint):
    r"""The constraints of a [`MechanicalSystem`][] on its state `(q, v)`:
    `phi(t, q) = 0`, `J v + dphi/dt = 0` with `J = dphi/dq`, and `a(t, q, v) = 0`.

    Built by `MechanicalSystem.constraint`. Corrections use its structure: first the positions,
    then the velocities, which is a linear problem, with the same matrix. The derivative of
    `J v` is never formed.
    """

    holonomic: Callable | None
    nonholonomic: Callable | None
    mass_matrix: Callable  # (t, q, v, args)
    redundant: bool = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Any:
        equations = Kinematics(self, y)
        x, w = equations.flat(y)
        t = jnp.asarray(t, x.dtype)
        return equations.position(t, x, args), equations.velocity(t, w, (x, args))

    def check_mass(self, t: RealScalarLike, y: Y, args: Args) -> tuple[BoolScalar, BoolScalar]:
        """Whether the mass matrix is symmetric, and positive definite as far as it must be."""
        equations = Kinematics(self, y)
        x, w = equations.flat(y)
        t = jnp.asarray(t, x.dtype)
        mass = equations.mass(t, x, w, args, equations.rows(t, x, w, args)[0])
        return mass.symmetric, mass.positive


class Kinematics:
    """The constraints as functions of vectors, `x` for positions and `w` for velocities."""

    def __init__(self, constraint: MechanicalConstraint, y: Y):
        q, _ = check_mechanical_state(y)
        _, self.unravel = jfu.ravel_pytree(q)
        self.constraint = constraint

    def flat(self, y: Y) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        q, v = y
        return jfu.ravel_pytree(q)[0], jfu.ravel_pytree(v)[0]

    def position(self, t: Array, x: Float[Array, " n"], args: Args) -> Float[Array, " p"]:
        if self.constraint.holonomic is None:
            return jnp.zeros((0,), x.dtype)
        return jfu.ravel_pytree(self.constraint.holonomic(t, self.unravel(x), args))[0]

    def velocity(
        self, t: Array, w: Float[Array, " n"], context: tuple[Float[Array, " n"], Args]
    ) -> Float[Array, " m"]:
        """Residual of the velocities at the positions in `context`."""
        x, args = context
        position = lambda t, x: self.position(t, x, args)
        _, rate = jax.jvp(position, (t, x), (jnp.ones_like(t), w))
        if self.constraint.nonholonomic is None:
            return rate
        extra = self.constraint.nonholonomic(t, self.unravel(x), self.unravel(w), args)
        return jnp.concatenate([rate, jfu.ravel_pytree(extra)[0]])

    def rows(
        self, t: Array, x: Float[Array, " n"], w: Float[Array, " n"], args: Args
    ) -> tuple[Float[Array, "m n"], int]:
        """`C = [J; da/dv]`, and how many of the rows belong to positions."""
        _, J = jacobian(lambda x: self.position(t, x, args), x)
        if self.constraint.nonholonomic is None:
            return J, J.shape[0]
        nonholonomic = lambda w: self.velocity(t, w, (x, args))[J.shape[0] :]
        return jnp.concatenate([J, jacobian(nonholonomic, w)[1]]), J.shape[0]

    def acceleration_bias(
        self, t: Array, x: Float[Array, " n"], w: Float[Array, " n"], args: Args
    ) -> Float[Array, " m"]:
        """What the second derivative of the constraints is at zero acceleration."""
        velocity = lambda t, x: self.velocity(t, w, (x, args))
        return jax.jvp(velocity, (t, x), (jnp.ones_like(t), w))[1]

    def mass(
        self,
        t: Array,
        x: Float[Array, " n"],
        w: Float[Array, " n"],
        args: Args,
        C: Float[Array, "m n"],
    ) -> Mass:
        q, v = self.unravel(x), self.unravel(w)
        values = mass_values(self.constraint.mass_matrix(t, q, v, args), q)
        return factorize_mass(values, C)


def check_mechanical_state(y: Y) -> tuple[Any, Any]:
    """Refuse, while tracing, states that are not `(q, v)`."""
    if not (isinstance(y, tuple) and len(y) == 2):
        raise ValueError(
            "`y` must be the tuple `(q, v)` of positions and velocities of a mechanical system, got "
            f"{type(y).__name__}. Write e.g. `y0 = (q0, jnp.zeros_like(q0))`."
        )
    q, v = y
    shapes = lambda tree: jtu.tree_map(jnp.shape, tree)
    if jtu.tree_structure(q) != jtu.tree_structure(v) or shapes(q) != shapes(v):
        raise ValueError(
            f"`y` = (q, v) must have velocities of the same structure and shapes as the positions, v = dq/dt, got "
            f"{shapes(q)} and {shapes(v)}."
        )
    return q, v
