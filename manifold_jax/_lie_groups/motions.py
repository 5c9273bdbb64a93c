"""Rigid-body motions: rotation and translation together."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .algebra import (
    cosine_quotient,
    cotangent_defect,
    cross,
    hat,
    is_within_half_a_turn,
    Rotation,
    rotation_rate,
    sine_defect,
    vee,
)
from .group import AbstractLieGroup, check_shape


class SE3(AbstractLieGroup):
    r"""Motions of a rigid body, matrices `[[R, p], [0, 1]]` of shape `(4, 4)` that take its points
    into space: $R' = R\,\hat\omega$, $p' = R\,u$ with the velocity $(\omega, u)$, shape `(6,)`, in
    the frame of the body.

    The constraint is that of `R`, the last row being constant:

    ```python
    mj.Constraint(lambda t, y, args: mj.Stiefel()(t, y[:3, :3]))
    ```
    """

    dimension: ClassVar[int] = 6

    def tangent(self, y, velocity):
        check_shape(y, (4, 4), "SE3")
        R = y[:3, :3]
        columns = jnp.concatenate([hat(velocity[:3]), velocity[3:, None]], axis=1)
        return jnp.concatenate([_product(R, columns), jnp.zeros_like(y[3:])])

    def velocity(self, y, tangent):
        check_shape(y, (4, 4), "SE3")
        columns = _product(y[:3, :3].T, tangent[:3])
        return jnp.concatenate([vee(columns[:, :3]), columns[:, 3]])

    def moved(self, y, w, cayley):
        a, v = w[:3], w[3:]
        once = cross(a, v)
        if cayley:
            shift = (v + once / 2 + a * (jnp.sum(a * v) / 4)) / (1 + jnp.sum(a * a) / 4)
        else:
            square = jnp.sum(a * a)
            shift = v + cosine_quotient(square) * once + sine_defect(square) * cross(a, once)
        columns = jnp.concatenate([Rotation.of(a, cayley).matrix(), shift[:, None]], axis=1)
        top = _product(y[:3, :3], columns) + jnp.concatenate(
            [jnp.zeros_like(y[:3, :3]), y[:3, 3:]], axis=1
        )
        return jnp.concatenate([top, y[3:]])

    def rate(self, w, velocity, cayley):
        if not cayley:
            return _inverse_of_exponential(w, velocity)
        a, v, omega, u = w[:3], w[3:], velocity[:3], velocity[3:]
        translation = u - cross(omega, v) / 2
        translation = translation + cross(a, translation) / 2
        return jnp.concatenate([rotation_rate(a, omega, True), translation])

    def is_within(self, w, cayley):
        return jnp.all(jnp.isfinite(w)) & is_within_half_a_turn(w[:3], cayley)


def _inverse_of_exponential(w: Float[Array, "6"], x: Float[Array, "6"]) -> Float[Array, "6"]:
    r"""$x + \mathrm{ad}\,x / 2 + A\,\mathrm{ad}^2 x + B\,\mathrm{ad}^4 x$ with
    $\alpha = \frac\theta2 \cot\frac\theta2$, $\beta = (\frac\theta2 / \sin\frac\theta2)^2$,
    $A \theta^2 = 2 (1 - \alpha) + (\alpha - \beta) / 2$, $B \theta^4 = 1 - \alpha + (\alpha - \beta) / 2$.

    Source: Bullo & Murray, Proportional derivative control on the Euclidean group, European Control
    Conference (1995), appendix.
    """
    square = jnp.sum(w[:3] ** 2)
    once = _bracket(w, x)
    twice = _bracket(w, once)
    fourth = _bracket(w, _bracket(w, twice))
    # gamma = (1 - alpha) / theta^2, and its derivative with respect to theta^2: alpha - beta =
    # -2 theta^2 (gamma + theta^2 gamma'), from the derivative of the cotangent.
    gamma, slope = jax.jvp(cotangent_defect, (square,), (jnp.ones_like(square),))
    A, B = gamma - square * slope, -slope
    return x + once / 2 + A * twice + B * fourth


def _bracket(w: Float[Array, "6"], x: Float[Array, "6"]) -> Float[Array, "6"]:
    a, v, omega, u = w[:3], w[3:], x[:3], x[3:]
    return jnp.concatenate([cross(a, omega), cross(a, u) + cross(v, omega)])


def _product(A: Float[Array, "i j"], B: Float[Array, "j k"]) -> Float[Array, "i k"]:
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)
