"""Matrices with orthonormal columns, rotation matrices among them."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import manifold_jax as mj


# Near the manifold: with squares of singular values within 1/2 of 1, 4 iterations converge.
_CONVERGES, _NEAR = 0.5, 4
# From anywhere: the smallest singular value grows by 1.875 at first, 1e-12 of the largest needs 44.
_FAR = 52


class Stiefel(mj.AbstractConstraint):
    r"""Matrices with orthonormal columns, $Y^T Y = I$; square ones are orthogonal, and stay rotations
    if they start as such.

    ```python
    sol = mj.diffeqsolve(terms, mj.Projected(dfx.Tsit5(), mj.Stiefel()), ..., y0=jnp.eye(3))
    ```

    The state is one array of shape `(n, k)`, `n >= k`. It corrects itself by the polar factor
    $Y (Y^T Y)^{-1/2}$, the nearest matrix with orthonormal columns, computed by products of matrices
    alone:

    $$Y \leftarrow Y (15 I - 10\, Y^T Y + 3\, (Y^T Y)^2) / 8,$$

    which converges cubically and is differentiated as it stands. (Newton's method, as for any
    [`Constraint`][], with another metric than the identity and along directions that are given.)

    The residual is the upper triangle of $Y^T Y - I$, `k (k + 1) / 2` numbers.

    Source: Higham, Functions of Matrices (2008), chapter 8 (polar decomposition, Newton-Schulz and
    higher order iterations).
    """

    redundant: ClassVar[bool] = False

    def __call__(self, t: Any, y: Any, args: Any = None) -> Float[Array, " m"]:
        _check(y)
        k = y.shape[1]
        return (_gram(y) - jnp.eye(k, dtype=y.dtype))[jnp.triu_indices(k)]

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Any, mj.ProjectionInfo]:
        if directions is not None or not projection.is_euclidean:
            return super().correct(
                projection, t, y, args, fallback=fallback, far=far, directions=directions
            )
        finite = jnp.all(jnp.isfinite(y))
        safe = jax.lax.stop_gradient(y if fallback is None else fallback)
        if far:
            polar = _polar_from_anywhere
            there = polar(jax.lax.stop_gradient(jnp.where(finite, y, safe)))
            success = finite & (self._residual(there) <= projection.tolerance_for(y.dtype))
        else:
            polar = _polar
            deviation = _gram(y) - jnp.eye(y.shape[1], dtype=y.dtype)
            success = finite & (jnp.sum(deviation**2) <= _CONVERGES**2)
        # Replaced where it fails before it is differentiated: iterations that diverge overflow.
        x = jnp.where(success, y, safe)
        p = polar(x)
        # A point on the manifold to rounding stays as it is, but its derivative does not.
        there = self._residual(x) <= 2 * jnp.finfo(y.dtype).eps
        p = jnp.where(success, jnp.where(there, p + jax.lax.stop_gradient(x - p), p), y)
        residual = jnp.where(finite, self._residual(jax.lax.stop_gradient(p)), jnp.nan)
        return p, mj.ProjectionInfo.of_formula(y, p, residual, success)

    def _residual(self, y: Float[Array, "n k"]) -> Float[Array, ""]:
        return jnp.max(jnp.abs(_gram(y) - jnp.eye(y.shape[1], dtype=y.dtype)))


def _polar(Y: Float[Array, "n k"]) -> Float[Array, "n k"]:
    for _ in range(_NEAR):
        Y = _improved(Y)
    return Y


def _polar_from_anywhere(Y: Float[Array, "n k"]) -> Float[Array, "n k"]:
    size = jnp.sqrt(jnp.sum(jnp.square(Y)))  # the polar factor does not depend on it
    Y = Y / jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
    return jax.lax.scan(lambda Y, _: (_improved(Y), None), Y, length=_FAR)[0]


def _improved(Y: Float[Array, "n k"]) -> Float[Array, "n k"]:
    A = _gram(Y)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    return _product(Y, (15 * eye - 10 * A + 3 * _product(A, A)) / 8)


def _gram(Y: Float[Array, "n k"]) -> Float[Array, "k k"]:
    return _product(Y.T, Y)


def _product(A: Float[Array, "i j"], B: Float[Array, "j l"]) -> Float[Array, "i l"]:
    """Multiply small matrices as sums, which fuse with the surrounding operations."""
    if max(*A.shape, B.shape[1]) > 8:
        return A @ B
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)


def _check(y: Any) -> None:
    if not hasattr(y, "shape") or len(y.shape) != 2 or y.shape[0] < y.shape[1]:
        got = jnp.shape(y) if hasattr(y, "shape") else type(y).__name__
        raise ValueError(
            f"`y` must be one matrix of shape (n, k) with n >= k for `mj.Stiefel()`, got {got}. For parts of "
            "a state use `mj.Product`."
        )
