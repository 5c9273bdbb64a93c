"""A vector field that knows in which direction of time it is integrated."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu

from ._custom_types import Args, RealScalarLike, Y


class DirectedTerm(dfx.AbstractTerm):
    """`dy = (f(t, y) + s d(t, y)) dt` with `s` the sign of the step: damping `d` that damps
    backwards in time, too. The vector field returns `(f, d)`; `rate` (1/time) is that of the
    fastest decay."""

    vector_field: Callable
    rate: RealScalarLike

    def vf(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, Y]:
        return self.vector_field(t, y, args)

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs: Any) -> RealScalarLike:
        return t1 - t0

    def prod(self, vf: tuple[Y, Y], control: RealScalarLike) -> Y:
        field, damping = vf
        sign = jnp.sign(control)
        return jtu.tree_map(lambda f, d: (control * (f + sign * d)).astype(f.dtype), field, damping)
