"""The interface of Lie groups that can be integrated in their algebra."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float


class AbstractLieGroup(eqx.Module):
    r"""A Lie group whose elements `y` are arrays, near one of them written as $y_0 \phi(w)$ with a
    vector `w` of the algebra and $\phi$ the exponential or Cayley's map.

    Velocities are those in the frame of the body, $y' = y\,\xi$. Implementations have no arrays of
    their own. All methods are traced, and differentiable also at `w = 0`.
    """

    dimension: eqx.AbstractVar[int]  # of the algebra

    @abc.abstractmethod
    def tangent(self, y: Array, velocity: Float[Array, " d"]) -> Array:
        r"""Return the velocity $y\,\xi$ of the state, like `y`, for fields known in the algebra."""

    @abc.abstractmethod
    def velocity(self, y: Array, tangent: Array) -> Float[Array, " d"]:
        r"""Return the inverse, $\xi = y^{-1} y'$."""

    @abc.abstractmethod
    def moved(self, y: Array, w: Float[Array, " d"], cayley: bool) -> Array:
        r"""Return $y\,\phi(w)$."""

    @abc.abstractmethod
    def rate(
        self, w: Float[Array, " d"], velocity: Float[Array, " d"], cayley: bool
    ) -> Float[Array, " d"]:
        r"""Return $w'$ where $y_0 \phi(w)$ has the velocity $\xi$: the inverse of the derivative of
        $\phi$ applied to it."""

    @abc.abstractmethod
    def is_within(self, w: Float[Array, " d"], cayley: bool) -> Bool[Array, ""]:
        r"""Whether $\phi$ is a chart at `w`, well inside; a step that leaves it is rejected. False if
        `w` is not finite."""


def check_shape(y: Any, shape: tuple[int, ...], group: str) -> None:
    if getattr(y, "shape", None) != shape:
        got = getattr(y, "shape", type(y).__name__)
        raise ValueError(
            f"`groups`: a part of the state for `mj.{group}()` must have shape {shape}, got {got}."
        )
