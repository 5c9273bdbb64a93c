"""What is known of `M y' = f` at one time and state."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.types import BoolScalar, FloatScalar


class LinearizedEquations(NamedTuple):
    """The equations linearized at one time and state.

    - `derivative`: `y'`.
    - `newton`: Newton's step towards consistency.
    - `kept`: `A^-1 M change`; added to `newton`, the step to the solution that has the `M y` of a state
        which differs by `change`.
    - `residual`: the largest residual of an algebraic equation, relative to its change when the unknowns
        change by `|x| + 1`. Rounding of the state leaves a few units of it, but far more of `newton` where
        equations are badly conditioned.
    - `finite`, `nonsingular`: whether the equations are defined there, and of index 1.
    """

    derivative: Float[Array, " n"]
    newton: Float[Array, " n"]
    kept: Callable[[Float[Array, " n"]], Float[Array, " n"]]
    residual: FloatScalar
    finite: BoolScalar
    nonsingular: BoolScalar


def relative_residual(r: Float[Array, " n"], size: Float[Array, " n"]) -> FloatScalar:
    """Return the largest residual relative to the size of its terms."""
    return jnp.max(jnp.where(r == 0, 0, jnp.abs(r) / size), initial=0.0)
