"""First and second order conditions for a minimum of `f(x)` subject to `g(x) = 0`."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, FloatScalar
from .._constraint.residual import jacobian, row_scale
from .._linalg.dense import Factorization, factorize, gram
from .._linalg.newton import AbstractEquations, find_root, implicit_root, without_derivative
from .._linalg.pivoted import factorize_by_reduction


class Lagrangian(eqx.Module):
    """`L(x, lambda) = f(x) + lambda . g(x)`, for vectors.

    Closed-over arrays of the user's functions are leaves, so that it can be differentiated or held
    fixed.
    """

    objective: Callable
    residual: Callable
    args: Args

    def f(self, x: Float[Array, " n"]) -> FloatScalar:
        return self.objective(x, self.args)

    def g(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        return self.residual(x, self.args)

    def __call__(self, x: Float[Array, " n"], multipliers: Float[Array, " m"]) -> FloatScalar:
        return self.f(x) + multipliers @ self.g(x)

    def normals(self, x: Float[Array, " n"]) -> tuple[Float[Array, "m n"], Factorization]:
        """Return `G = dg/dx` and the factors of `G G^T`."""
        _, G = jacobian(self.g, x)
        return G, factorize(gram(G, G))

    def projected_gradient(
        self, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Return `P grad f = grad f + G^T lambda` and `lambda`, `P = I - G^T (G G^T)^-1 G`."""
        G, factorization = self.normals(x)
        gradient = jax.grad(self.f)(x)
        multipliers = -factorization.solve(G @ gradient)
        return gradient + multipliers @ G, multipliers

    def curvature(
        self, x: Float[Array, " n"], multipliers: Float[Array, " m"]
    ) -> tuple[FloatScalar, FloatScalar]:
        """Return the smallest eigenvalue of the Hessian of `L` on the tangent space, and the size of
        that Hessian, its largest absolute row sum.

        The normal space is moved to the far end of the spectrum. Unlike with a basis of the tangent
        space, everything can be differentiated.
        """
        G, factorization = self.normals(x)
        H = jax.hessian(self)(x, multipliers)
        size = jnp.max(jnp.sum(jnp.abs(H), axis=1))
        m, n = G.shape
        if m == n:
            return jnp.asarray(jnp.inf, x.dtype), size
        normal = G.T @ factorization.solve(G)
        P = jnp.eye(n, dtype=x.dtype) - normal
        return jnp.min(jnp.linalg.eigvalsh(P @ H @ P + size * normal)), size


class _Conditions(AbstractEquations):
    """`grad f + G^T lambda = 0` and `g = 0`, each row divided by its typical size."""

    lagrangian: Lagrangian
    sizes: Float[Array, " n_plus_m"]
    n: int = eqx.field(static=True)

    def point(self, z: Float[Array, " n_plus_m"]) -> Float[Array, " n_plus_m"]:
        return z

    def linearize(self, x: Float[Array, " n_plus_m"]) -> Factorization:
        return factorize_by_reduction(jax.jacfwd(self.residual)(x))

    def residual(self, x: Float[Array, " n_plus_m"]) -> Float[Array, " n_plus_m"]:
        x, multipliers = x[: self.n], x[self.n :]
        slopes = jax.grad(self.lagrangian)(x, multipliers)
        return jnp.concatenate([slopes, self.lagrangian.g(x)]) / self.sizes


def stationary_point(
    lagrangian: Lagrangian, near: Float[Array, " n"], reach: FloatScalar, size: FloatScalar
) -> tuple[Float[Array, " n"], Float[Array, " m"], FloatScalar, BoolScalar]:
    """Return the point at which the first order conditions hold, with its derivative, its multipliers
    and curvature, and whether it is a minimum.

    Newton's method from `near`, which must already be close: a result that is further away than
    `reach (|x| + 1)` belongs to another basin, and `near` is kept.

    It is a strict minimum if the curvature is positive, beyond rounding errors and without much change
    over the distance to which the point is known, two steps of Newton's method from `near`. (Where the
    curvature vanishes at the stationary point itself, a step leads only part of the way there.)

    **Arguments:**

    - `size`: typical size of the gradient of `f`.
    """
    n = near.shape[0]
    fixed, near = without_derivative((lagrangian, near))
    guess = jnp.concatenate([near, fixed.projected_gradient(near)[1]])
    row_sizes = row_scale(fixed.normals(near)[0], near)
    sizes = jnp.concatenate([jnp.broadcast_to(size, near.shape), row_sizes])
    conditions = _Conditions(fixed, sizes, n)
    root = find_root(conditions, guess)
    moved = jnp.max(jnp.abs(root[:n] - near) / (jnp.abs(near) + 1))
    point = jnp.where(moved <= reach, root, guess)
    point = implicit_root(_Conditions(lagrangian, sizes, n), point)

    beyond = guess - 2 * conditions.linearize(guess).solve(conditions.residual(guess))
    points = jnp.stack([point, guess, beyond])
    curvatures, bends = jax.vmap(lambda p: lagrangian.curvature(p[:n], p[n:]))(points)
    rounding = 100 * n * jnp.finfo(near.dtype).eps * bends[0]
    least = jnp.min(curvatures)
    positive = (least > rounding) & (jnp.max(curvatures) <= 2 * least)
    return point[:n], point[n:], curvatures[0], positive
