"""Dense output: interpolants that end where the corrected steps do, and stay on the manifold."""

import copy
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._base.types import Args, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.settings import NewtonProjection


class CorrectedInterpolation(dfx.AbstractLocalInterpolation):
    """A solver's own interpolant, bent so that it ends at the corrected state:
    `inner(t) + s^2 (3 - 2 s) (y1 - inner(t1))`, with `s` from 0 to 1 over the step.

    Without this the interpolant would jump at every step by the size of the correction, and the search
    for the time of an event could find no root.
    """

    t0: RealScalarLike
    t1: RealScalarLike
    inner: dfx.AbstractLocalInterpolation
    y1: Y
    correction: Y

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        value = self.inner.evaluate(t0, left=left)
        width = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(width == 0, 1, width)
        blend = s**2 * (3 - 2 * s)
        bent = jtu.tree_map(lambda v, c: v + (blend * c).astype(v.dtype), value, self.correction)
        # The corrected state exactly at the end, not only up to rounding; the derivative with respect
        # to time stays that of the interpolant.
        at_end = t0 == self.t1
        rest = jtu.tree_map(lambda y, b: jnp.where(at_end, y - b, 0), self.y1, bent)
        return jtu.tree_map(jnp.add, bent, jax.lax.stop_gradient(rest))


class InterpolationOfCoordinates(dfx.AbstractLocalInterpolation):
    """The states that belong to interpolated coordinates around the state `start`."""

    t0: RealScalarLike
    t1: RealScalarLike
    inner: dfx.AbstractLocalInterpolation
    start: Y
    state: Callable[[Y, Y], Y] = eqx.field(static=True)

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        return self.state(self.start, self.inner.evaluate(t0, left=left))


class CorrectedInterpolationFactory(eqx.Module):
    """Builds [`CorrectedInterpolation`][] from the `dense_info` of a step.

    Diffrax keeps `interpolation_cls` in a static field, so this holds no arrays. `state(start, w)`
    converts interpolated coordinates to a state, if they are not states.
    """

    inner: Callable[..., dfx.AbstractLocalInterpolation] = eqx.field(static=True)
    bend: bool = eqx.field(static=True)
    state: Callable[[Y, Y], Y] | None = eqx.field(static=True, default=None)

    def __call__(
        self, *, t0, t1, corrected, correction, start=None, **info
    ) -> dfx.AbstractLocalInterpolation:
        inner = self.inner(t0=t0, t1=t1, **info)
        if self.state is not None:
            inner = InterpolationOfCoordinates(t0, t1, inner, start, self.state)
        if not self.bend:
            return inner
        return CorrectedInterpolation(
            t0=t0, t1=t1, inner=inner, y1=corrected, correction=correction
        )


class ManifoldInterpolation(dfx.AbstractPath):
    """The dense solution of a solve, with every value on the manifold.

    Evaluates the piecewise interpolant of the steps and corrects the value. A value that cannot be
    corrected is NaN.

    Only arrays are leaves, as a solution may be returned from `jax.jit`: closed-over arrays of the
    constraint are among them, its functions are not.
    """

    inner: dfx.AbstractPath
    arrays: Any
    functions: tuple[tuple[Any, ...], Any] = eqx.field(static=True)

    @staticmethod
    def build(
        inner: dfx.AbstractPath,
        constraint: AbstractConstraint,
        projection: NewtonProjection,
        t: Array,
        y: Y,
        args: Args,
    ) -> "ManifoldInterpolation":
        """Build the solution; `t` and `y` are examples of a time and a state."""

        def correct(t: Array, y: Y) -> Y:
            corrected, info = constraint.correct(projection, t, y, args)
            return jtu.tree_map(lambda leaf: jnp.where(info.success, leaf, jnp.nan), corrected)

        correct = eqx.filter_closure_convert(correct, t, y)
        is_array = lambda x: isinstance(x, jax.Array | np.ndarray)
        arrays, functions = eqx.partition(correct, is_array)
        leaves, tree = jtu.tree_flatten(functions)
        return ManifoldInterpolation(inner, arrays, (tuple(leaves), tree))

    def __deepcopy__(self, memo: dict[int, Any]) -> "ManifoldInterpolation":
        """Copy with its own arrays; traced functions are shared."""
        inner, arrays = copy.deepcopy((self.inner, self.arrays), memo)
        return ManifoldInterpolation(inner, arrays, self.functions)

    def __reduce__(self) -> Any:
        raise TypeError(
            "A dense solution on a manifold cannot be pickled, as it holds traced functions of the constraint. Save "
            "values, `jax.vmap(sol.evaluate)(ts)`, or what it was solved from; `copy.deepcopy` works."
        )

    @property
    def t0(self):  # pyright: ignore
        return self.inner.t0

    @property
    def t1(self):  # pyright: ignore
        return self.inner.t1

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(
                jnp.subtract, self.evaluate(t1, left=left), self.evaluate(t0, left=left)
            )
        dtype = self.inner.ts.dtype  # pyright: ignore
        t0 = jnp.asarray(t0, dtype)
        if t0.ndim > 0:
            raise ValueError(
                f"`t0` must be one time, got shape {t0.shape}. Write `jax.vmap(sol.evaluate)(ts)`."
            )
        leaves, tree = self.functions
        correct = eqx.combine(self.arrays, jtu.tree_unflatten(tree, leaves))
        return correct(t0, self.inner.evaluate(t0, left=left))

    def derivative(self, t: RealScalarLike, left: bool = True) -> Y:
        t = jnp.asarray(t, dtype=jnp.result_type(float, t))
        _, out = jax.jvp(lambda t: self.evaluate(t, left=left), (t,), (jnp.ones_like(t),))
        return out
