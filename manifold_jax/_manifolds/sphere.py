"""Spheres: unit vectors, quaternions and other states of a fixed length."""

import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

import manifold_jax as mj


class Sphere(mj.AbstractConstraint):
    """`|y|^2 = r^2` with `|y|^2` the sum of all squares in the state: unit vectors, quaternions.

    ```python
    mj.Projected(dfx.Tsit5(), mj.Sphere())
    ```

    Corrects itself by `p = (r / |y|) y`, the nearest point, without iteration, from anywhere but
    the centre. (Newton's method, as for any [`Constraint`][], with another metric than the
    identity and along directions that are given.)

    **Arguments:**

    - `radius`: `r > 0`, a number or an array.

    For parts of a state that have lengths of their own use [`Product`][].
    """

    radius: float | Float[Array, ""] = 1.0
    redundant: ClassVar[bool] = False

    def __check_init__(self):
        if isinstance(self.radius, int | float) and not self.radius > 0:
            raise ValueError(f"`radius` must be positive, got {self.radius}.")

    def __call__(self, t: Any, y: Any, args: Any = None) -> Float[Array, ""]:
        return _square(y) - self.radius**2

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Any, mj.ProjectionInfo]:
        if directions is not None or not projection.is_euclidean:
            return super().correct(
                projection, t, y, args, fallback=fallback, far=far, directions=directions
            )
        square, target = _square(y), self.radius**2
        success = jnp.isfinite(square) & (square > 0)
        # Replaced where it fails before anything is computed: the derivative of a NaN is never zero.
        fallback = jax.lax.stop_gradient(y if fallback is None else fallback)
        x = jtu.tree_map(lambda a, b: jnp.where(success, a, b), y, fallback)
        size = _square(x)
        scale = self.radius / jnp.sqrt(jnp.where(size > 0, size, 1))
        # A point on the sphere to rounding stays as it is, but its derivative does not.
        there = jnp.abs(size - target) <= 2 * jnp.finfo(square.dtype).eps * target
        scale = jnp.where(there, scale + jax.lax.stop_gradient(1 - scale), scale)
        moved = jtu.tree_map(lambda a: scale.astype(a.dtype) * a, x)
        p = jtu.tree_map(lambda a, b: jnp.where(success, a, b), moved, y)
        residual = jnp.where(success, jnp.abs(_square(moved) - target), jnp.nan)
        return p, mj.ProjectionInfo.of_formula(y, p, residual / target, success)


def _square(y: Any) -> Float[Array, ""]:
    squares = [jnp.sum(jnp.square(leaf)) for leaf in jtu.tree_leaves(y)]
    return functools.reduce(jnp.add, squares)
