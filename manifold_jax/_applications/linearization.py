"""The linearization of a vector field on the tangent space of its manifold."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Complex, Float

from .._base.numbers import numbers_as_arrays
from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import as_constraint
from .._constraint.constraint import AbstractConstraint
from .._constraint.residual import residual_vector
from .._linalg.dense import pseudo_invert


_DEPENDENT = 1e-9


class Linearization(eqx.Module):
    """What [`linearize`][manifold_jax.linearize] returns, for `d` tangent coordinates `z`.

    **Attributes:**

    - `matrix`: `A` of `z' = A z`, shape `(d, d)`.
    - `by_args`: the derivatives of `z'` by the numbers in `args`, `(d, ...)` for each leaf: the columns of
        the input matrix `B` for leaves that are inputs.
    - `basis`: the tangent vectors `T`, orthonormal columns `(n, d)`; rows in the order of `ravel_pytree(y)`.
        Which basis it is has no meaning: positions and velocities are mixed. Weights `Q` of all components
        of `y` are `T^T Q T` for `z`.
    - `y`: the state.
    """

    matrix: Float[Array, "d d"]
    by_args: Any
    basis: Float[Array, "n d"]
    y: Y

    def coordinates(self, y: Y) -> Float[Array, " d"]:
        """Return `z = T^T (y - y0)` of a state near the one of the linearization."""
        difference = jtu.tree_map(lambda a, b: a - b, y, self.y)
        return self.basis.T @ jfu.ravel_pytree(difference)[0]

    def eigenvalues(self) -> Complex[Array, " d"]:
        """Return the eigenvalues of `A`, rates and angular frequencies (1/s), sorted by the imaginary and
        then the real part. With derivatives where they are distinct; JAX has them on CPUs only."""
        values = jnp.linalg.eigvals(self.matrix)
        order = jnp.lexsort((values.real, values.imag))
        return values[order]


@numbers_as_arrays("args", times=("t",))
def linearize(
    terms: Any,
    constraint: AbstractConstraint | None,
    t: RealScalarLike,
    y: Y,
    args: Args = None,
) -> Linearization:
    r"""Linearize a vector field on the tangent space of its manifold at `y`:

    $$z' = A z + \sum_k \partial_k z'\,\delta a_k, \qquad \delta y = T z, \quad A = T^T \frac{\partial f}{\partial y} T.$$

    At an equilibrium the eigenvalues of `A` are those of all small motions that the constraint allows:
    as many as degrees of freedom, without the spurious ones at zero that the equations in all coordinates
    have. Along a motion `A` belongs to tangent vectors that do not turn in the tangent space: its eigenvalues depend on
    the coordinates of the state and do not decide on stability. (Those of a top that spins upright are others in poses
    than in the coordinates of its joint.)

    ```python
    at_rest = mj.linearize(system.terms, system.constraint, 0.0, y0, args)
    frequencies = jnp.abs(at_rest.eigenvalues().imag) / (2 * jnp.pi)  # Hz
    A, B = at_rest.matrix, at_rest.by_args  # for scipy.linalg.solve_continuous_are
    ```

    **Arguments:**

    - `terms`: the vector field, a `diffrax.ODETerm`, such as `MechanicalSystem.terms`. It must be tangent to
        the manifold, see [`tangent_field`][].
    - `constraint`: the manifold, or `None` for all of the state space, such as that of
        [`JointCoordinates`][manifold_jax.multibody.JointCoordinates] of a tree: `z` are then the numbers of
        `y`. With `redundant=True` the number of its dimensions must be found from the numbers: not inside `jit` or
        derivatives.
    - `t`, `y`, `args`: where to linearize. `y` must be on the manifold, see [`consistent_state`][].

    **Returns:** a [`Linearization`][]. Its derivatives by `y` and `args` are those of a basis that moves with
    the manifold, hence exact for eigenvalues and other numbers that do not depend on the basis.

    **Raises** `ValueError` if the equations of `constraint` depend on each other in `y`, unless `redundant`; inside
    `jit` the result is NaN then.

    Source: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989); Negrut & Ortiz,
    J. Comput. Nonlinear Dyn. 1 (2006) 230-239 (linearization of constrained mechanisms).
    """
    constraint = as_constraint(constraint, "linearize(terms, constraint, t, y, args)")
    y = jtu.tree_map(jnp.asarray, y)
    G = _jacobian(constraint, t, y, args)
    kept = _basis(jax.lax.stop_gradient(G), constraint.redundant)
    matrix, by_args, T = _derivatives(terms, G, kept, t, y, args)
    return Linearization(matrix, by_args, T, y)


@eqx.filter_jit
def _jacobian(
    constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args
) -> Float[Array, "m n"]:
    x, unravel = jfu.ravel_pytree(y)
    return jax.jacrev(lambda x: residual_vector(constraint, t, unravel(x), args))(x)


@eqx.filter_jit
def _derivatives(
    terms: Any, G: Float[Array, "m n"], kept: Float[Array, "n d"], t: Any, y: Y, args: Args
) -> tuple[Float[Array, "d d"], Any, Float[Array, "n d"]]:
    """Return `A`, the derivatives by `args`, and the tangent vectors as functions of the state: their values
    are those that are `kept`."""
    T = kept - G.T @ pseudo_invert(G @ G.T, _DEPENDENT**2).solve(G @ kept)
    x, unravel = jfu.ravel_pytree(y)
    given, static = eqx.partition(args, eqx.is_inexact_array)
    a, unravel_args = jfu.ravel_pytree(given)

    def field(x: Float[Array, " n"], a: Float[Array, " m"]) -> Float[Array, " n"]:
        full = eqx.combine(unravel_args(a), static)
        return jfu.ravel_pytree(terms.vf(t, unravel(x), full))[0]

    # Along tangent vectors and parameters at once, so that the field is compiled once.
    d, m = kept.shape[1], a.size
    along = lambda dx, da: jax.jvp(field, (x, a), (dx, da))[1]
    every = jnp.pad(T, ((0, 0), (0, m))), jnp.eye(m, d + m, d, dtype=a.dtype)
    slopes = jnp.linalg.solve(kept.T @ T, kept.T @ jax.vmap(along, 1, 1)(*every))
    by_args = jax.vmap(unravel_args)(slopes[:, d:])
    return slopes[:, :d], by_args, T


def _basis(G: Float[Array, "m n"], redundant: bool) -> Float[Array, "n d"]:
    """Return an orthonormal basis of the null space."""
    _, sizes, right = jnp.linalg.svd(G, full_matrices=True)
    independent = sizes > _DEPENDENT * jnp.max(sizes, initial=0)
    rank, m = min(G.shape), G.shape[0]
    if not isinstance(sizes, jax.core.Tracer):
        rank = int(np.sum(np.asarray(independent)))
    elif redundant:
        raise ValueError(
            "`constraint` has `redundant=True`: the number of tangent directions depends on the numbers. Call `linearize` "
            "outside of `jit`, `vmap` and derivatives, or remove the dependent equations."
        )
    if rank < m and not redundant:
        raise ValueError(
            f"`constraint`: {m - rank} of the {m} equations depend on others in `y`. Remove them, start beside a singular "
            "point, or write `redundant=True`."
        )
    unknown = jnp.where(redundant | jnp.all(independent), 0, jnp.nan).astype(G.dtype)
    return right[rank:].T + unknown
