r"""Vectors as infinitesimal rotations: their exponential, Cayley's map, and the derivatives of both.

With $\theta = |w|$ and $\hat w v = w \times v$

$$\exp(\hat w) = I + a \hat w + b \hat w^2, \quad
a = \frac{\sin\theta}{\theta}, \quad b = \frac{1 - \cos\theta}{\theta^2}, \quad
c = \frac{\theta - \sin\theta}{\theta^3}, \qquad
\mathrm{cay}(\hat w) = I + \frac{\hat w + \hat w^2 / 2}{1 + \theta^2 / 4}.$$

Source: Iserles, Munthe-Kaas, Norsett & Zanna, Lie-group methods, Acta Numerica 9 (2000) 215-365,
appendix B (closed forms for so(3) and se(3)).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


Vector = Float[Array, "3"]
Scalar = Float[Array, ""]

# Squares of angles below which functions of them are computed by their Taylor series: 9 terms.
_SMALL = 0.25
_TERMS = 9


def cross(v: Vector, w: Vector) -> Vector:
    return jnp.stack(
        [v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0]]
    )


def hat(w: Vector) -> Float[Array, "3 3"]:
    x, y, z = w[0], w[1], w[2]
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row) for row in rows])


def vee(A: Float[Array, "3 3"]) -> Vector:
    """Return the vector of the skew part."""
    return jnp.stack([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]]) / 2


class Rotation(NamedTuple):
    r"""$I + p\,\hat w + q\,\hat w^2$, and its quaternion $(s, u\,w)$."""

    w: Vector
    p: Scalar
    q: Scalar
    s: Scalar
    u: Scalar

    @staticmethod
    def of(w: Vector, cayley: bool) -> "Rotation":
        square = jnp.sum(w * w)
        if cayley:
            size = 1 + square / 4
            root = jnp.sqrt(size)
            return Rotation(w, 1 / size, 0.5 / size, 1 / root, 0.5 / root)
        half = sine_quotient(square / 4)
        return Rotation(w, sine_quotient(square), half**2 / 2, cosine(square / 4), half / 2)

    def matrix(self) -> Float[Array, "3 3"]:
        A = hat(self.w)
        square = self.w[:, None] * self.w[None, :] - jnp.sum(self.w**2) * jnp.eye(3, dtype=A.dtype)
        return jnp.eye(3, dtype=A.dtype) + self.p * A + self.q * square

    def quaternion(self) -> Float[Array, "4"]:
        return jnp.concatenate([self.s[None], self.u * self.w])


def rotation_rate(w: Vector, velocity: Vector, cayley: bool) -> Vector:
    r"""Return $w'$ for the angular velocity $\omega$ in the frame of the body:
    $\omega + w \times \omega / 2 + \gamma\, w \times (w \times \omega)$,
    $\gamma = (1 - \frac\theta2 \cot\frac\theta2) / \theta^2$; for Cayley's map
    $\omega + w \times \omega / 2 + w\,(w \cdot \omega) / 4$."""
    once = cross(w, velocity)
    if cayley:
        return velocity + once / 2 + w * (jnp.sum(w * velocity) / 4)
    return velocity + once / 2 + cotangent_defect(jnp.sum(w * w)) * cross(w, once)


def is_within_half_a_turn(w: Vector, cayley: bool) -> Bool[Array, ""]:
    """Whether `w` is a turn by less than half a revolution. By Cayley's map every `w` is, as it turns
    by `2 arctan(|w| / 2)`."""
    square = jnp.sum(w * w)
    return jnp.isfinite(square) if cayley else square < jnp.pi**2


def cosine(x: Scalar) -> Scalar:
    r"""$\cos\sqrt x$."""
    coefficients = [(-1) ** k / math.factorial(2 * k) for k in range(_TERMS)]
    return _near_zero_by_series(x, coefficients, lambda r, x: jnp.cos(r))


def sine_quotient(x: Scalar) -> Scalar:
    r"""$a = \sin\sqrt x / \sqrt x$."""
    coefficients = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]
    return _near_zero_by_series(x, coefficients, lambda r, x: jnp.sin(r) / r)


def cosine_quotient(x: Scalar) -> Scalar:
    r"""$b = (1 - \cos\sqrt x) / x$."""
    return sine_quotient(x / 4) ** 2 / 2


def sine_defect(x: Scalar) -> Scalar:
    r"""$c = (\sqrt x - \sin\sqrt x) / \sqrt x^3$."""
    coefficients = [(-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS)]
    return _near_zero_by_series(x, coefficients, lambda r, x: (r - jnp.sin(r)) / (r * x))


def cotangent_defect(x: Scalar) -> Scalar:
    r"""$\gamma = (1 - \frac{\sqrt x}2 \cot\frac{\sqrt x}2) / x$."""
    return _near_zero_by_series(x, _COTANGENT, lambda r, x: (1 - r / 2 / jnp.tan(r / 2)) / x)


def _near_zero_by_series(
    x: Scalar, coefficients: list[float], formula: Callable[[Scalar, Scalar], Scalar]
) -> Scalar:
    small = x < _SMALL
    series = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        series = series * x + coefficient
    away = jnp.where(small, 1, x)
    return jnp.where(small, series, formula(jnp.sqrt(away), away))


# 1 - (r/2) cot(r/2) = sum_k |B_2k| r^2k / (2k)!, with the Bernoulli numbers B_2k.
_BERNOULLI = [1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798]
_COTANGENT = [B / math.factorial(2 * k + 2) for k, B in enumerate(_BERNOULLI)]
