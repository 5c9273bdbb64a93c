"""Which derivative of which unknown is in which equation, and with a constant coefficient or not."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.types import Args
from .._jaxpr.incidence import incidence
from .derivatives import pick
from .equations import Equations


class Point(NamedTuple):
    """Where equations are evaluated: a time, the vectors `(x, x', ...)` and parameters, of which
    the arrays can be traced."""

    t: Array
    jets: tuple[Array, ...]
    args: Any
    fixed_args: Any

    @staticmethod
    def of(equations: Equations, x: Array, args: Args) -> "Point":
        """Return the point with derivatives of zero. Floats in `args` are parameters like arrays
        are; whole numbers
        and everything else are taken as they are."""
        is_parameter = lambda leaf: eqx.is_inexact_array_like(leaf) or eqx.is_array(leaf)
        traced, fixed = eqx.partition(args, is_parameter)
        traced = jax.tree_util.tree_map(jnp.asarray, traced)
        jets = (x, *(jnp.zeros_like(x) for _ in range(equations.order)))
        return Point(jnp.zeros((), x.dtype), jets, traced, fixed)


class Occurrence(NamedTuple):
    """`there[i, k, j]`: derivative `k` of unknown `j` is in equation `i`; `varies[i, k, j]`: its
    coefficient there is not the same everywhere. `depends_on_time` and `on_args` say so of the
    equations, `coefficients_vary` if any coefficient depends on anything, parameters included."""

    there: np.ndarray
    varies: np.ndarray
    depends_on_time: np.ndarray
    depends_on_args: np.ndarray
    coefficients_vary: np.ndarray
    unknown_primitives: dict[str, int]

    @staticmethod
    def of(equations: Equations, point: Point) -> "Occurrence":
        n, levels = equations.n, equations.order + 1
        tracked = _inputs(point, n * levels)

        def residual(t: Array, jets: tuple[Array, ...], args: Any) -> Array:
            return equations(t, jets, eqx.combine(args, point.fixed_args))

        def rate(t: Array, jets: tuple[Array, ...], args: Any, dt: Array, rates: Any) -> Array:
            """Where it does not depend on a number, the coefficient of that number is constant:
            second derivatives are symmetric."""
            along = lambda t, jets: residual(t, jets, args)
            return jax.jvp(along, (t, jets), (dt, rates))[1]

        values = incidence(residual, *tracked)
        nothing = np.zeros_like(tracked[0][1]), np.zeros_like(tracked[1][1])
        directions = (point.t, nothing[0]), (point.jets, nothing[1])
        slopes = incidence(rate, *tracked, *directions)
        shape = n, levels, n
        return Occurrence(
            there=values.depends[:, :-2].reshape(shape),
            varies=slopes.depends[:, :-2].reshape(shape),
            depends_on_time=values.depends[:, -2],
            depends_on_args=values.depends[:, -1],
            coefficients_vary=slopes.depends.any(axis=1),  # pyright: ignore[reportArgumentType]
            unknown_primitives=values.unknown_primitives,
        )

    def without(self, before: "Occurrence", gone: dict[int, np.ndarray]) -> "Occurrence":
        """Return the occurrence in equations of which some were replaced: `gone[row][k, j]` is not
        in them, the others
        are those of `before`."""
        there = before.there.copy()
        for row, away in gone.items():
            there[row] = self.there[row] & ~away
        return self._replace(there=there)


def _inputs(point: Point, number: int) -> tuple[tuple[Any, np.ndarray], ...]:
    """The time and all parameters together count as one input each, after those of the jets."""
    leaves = jax.tree_util.tree_leaves(point.args)
    each = np.eye(number, number + 2, dtype=bool)
    one = lambda which, size: np.tile(np.arange(number + 2) == number + which, (size, 1))
    args = one(1, sum(int(np.size(leaf)) for leaf in leaves))
    return (point.t, one(0, 1)), (point.jets, each), (point.args, args)


def nonlinear_unknowns(
    equations: Equations, point: Point, levels: np.ndarray, unknowns: np.ndarray
) -> np.ndarray:
    """Return in which of the derivatives `levels` of the `unknowns`, which are changed together,
    each
    equation is not linear: shape `(n, number)`."""
    number = len(levels)
    leading = jnp.zeros(number, point.jets[0].dtype)

    def residual(w: Array, t: Array, jets: tuple[Array, ...], args: Any) -> Array:
        changed = []
        for k, x in enumerate(jets):
            index, here = np.arange(equations.n), levels == k
            index[unknowns[here]] = equations.n + np.nonzero(here)[0]
            changed.append(pick(jnp.concatenate([x, w]), index))
        return equations(t, tuple(changed), eqx.combine(args, point.fixed_args))

    def rate(w: Array, dw: Array, t: Array, jets: tuple[Array, ...], args: Any) -> Array:
        return jax.jvp(lambda w: residual(w, t, jets, args), (w,), (dw,))[1]

    nothing = lambda tree: np.zeros(
        (sum(int(np.size(leaf)) for leaf in jax.tree_util.tree_leaves(tree)), number), bool
    )
    others = [(tree, nothing(tree)) for tree in (leading, point.t, point.jets, point.args)]
    return incidence(rate, (leading, np.eye(number, dtype=bool)), *others).depends
