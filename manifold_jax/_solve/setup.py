"""Records of a problem and of the settings of a solve, built once in each public function."""

from typing import Any, Literal, NamedTuple, TypeAlias

import diffrax as dfx
import jax.numpy as jnp

from .._base.types import Args, FloatScalar, RealScalarLike, Y


Consistent: TypeAlias = Literal["project", "check", "assume"]


class ProblemData(NamedTuple):
    """The data that define one trajectory."""

    t0: Any  # a real number, as `t1`
    t1: Any
    y0: Y
    args: Args

    @property
    def direction(self) -> FloatScalar:
        t0 = jnp.asarray(self.t0)
        return jnp.where(t0 < self.t1, 1, -1).astype(t0.dtype)


class Setup(NamedTuple):
    """The settings of a solve: the arguments of `diffeqsolve` with these names."""

    terms: Any
    solver: Any
    dt0: RealScalarLike | None
    saveat: dfx.SaveAt
    controller: dfx.AbstractStepSizeController
    consistent: Consistent
    throw: bool
    event: dfx.Event | None = None
    max_steps: int | None = None
