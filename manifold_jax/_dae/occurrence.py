"""The occurrence of derivatives of unknowns in equations, with constant coefficients or not."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.types import Args
from .._jaxpr.incidence import incidence
from .derivatives import pick
from .equations import ResidualEquations


# Number of inputs of which it is found at the same time where they occur.
_AT_A_TIME = 2048


class Example(NamedTuple):
    """Equations and a point at which they are evaluated: a time, the vectors `(x, x', ...)` and
    parameters, whose arrays can be traced."""

    equations: ResidualEquations
    t: Array
    jets: tuple[Array, ...]
    args: Any
    fixed_args: Any

    @staticmethod
    def of(equations: ResidualEquations, x: Array, args: Args) -> "Example":
        """Take zero derivatives. Floats in `args` are parameters like arrays; all else is constant."""
        is_parameter = lambda leaf: eqx.is_inexact_array_like(leaf) or eqx.is_array(leaf)
        traced, fixed = eqx.partition(args, is_parameter)
        traced = jax.tree_util.tree_map(jnp.asarray, traced)
        jets = (x, *(jnp.zeros_like(x) for _ in range(equations.order)))
        return Example(equations, jnp.zeros((), x.dtype), jets, traced, fixed)

    def residual(self, t: Array, jets: tuple[Array, ...], args: Any) -> Array:
        return self.equations(t, jets, eqx.combine(args, self.fixed_args))


def tracked(tree: Any, inputs: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return `tree` with the inputs as which all its numbers count, for `incidence`."""
    size = sum(int(np.size(leaf)) for leaf in jax.tree_util.tree_leaves(tree))
    return tree, np.tile(inputs, (size, 1))


class Occurrence(NamedTuple):
    """`there[i, k, j]`: derivative `k` of unknown `j` occurs in equation `i`; `varies[i, k, j]`: its
    coefficient there is not constant. `depends_on_time` and `depends_on_args` hold for equations as a
    whole, `coefficients_vary` if any coefficient depends on anything, parameters included."""

    there: np.ndarray
    varies: np.ndarray
    depends_on_time: np.ndarray
    depends_on_args: np.ndarray
    coefficients_vary: np.ndarray
    unknown_primitives: dict[str, int]

    @staticmethod
    def of(example: Example) -> "Occurrence":
        """Find the occurrence, of some unknowns at a time: sets of all of many take much memory. Time and
        parameters count as one number each."""
        n, levels = example.equations.n, example.equations.order + 1

        def rate(t: Array, jets: tuple[Array, ...], args: Any, dt: Array, rates: Any) -> Array:
            """Return the derivative along a direction. If it does not depend on a number, the
            coefficient of that number is constant: second derivatives are symmetric."""
            along = lambda t, jets: example.residual(t, jets, args)
            return jax.jvp(along, (t, jets), (dt, rates))[1]

        there, varies = (np.zeros((n, levels * n + 2), bool) for _ in range(2))
        unknown_primitives = {}
        for start in range(0, levels * n + 2, _AT_A_TIME):
            part = slice(start, start + _AT_A_TIME)
            each = np.eye(
                levels * n + 2, min(_AT_A_TIME, levels * n + 2 - start), -start, dtype=bool
            )
            jets, time, parameters = each[:-2], each[-2], each[-1]
            inputs = (
                tracked(example.t, time),
                (example.jets, jets),
                tracked(example.args, parameters),
            )
            directions = [tracked(tree, np.zeros_like(time)) for tree in (example.t, example.jets)]
            values = incidence(example.residual, *inputs)
            there[:, part] = values.depends
            varies[:, part] = incidence(rate, *inputs, *directions).depends
            unknown_primitives.update(values.unknown_primitives)
        return Occurrence(
            there=there[:, :-2].reshape(n, levels, n),
            varies=varies[:, :-2].reshape(n, levels, n),
            depends_on_time=there[:, -2],
            depends_on_args=there[:, -1],
            coefficients_vary=varies.any(axis=1),  # pyright: ignore[reportArgumentType]
            unknown_primitives=unknown_primitives,
        )

    def without(self, before: "Occurrence", gone: dict[int, np.ndarray]) -> "Occurrence":
        """Return the occurrence after some equations were replaced: `gone[row][k, j]` does not occur in
        them, the other equations are those of `before`."""
        there = before.there.copy()
        for row, away in gone.items():
            there[row] = self.there[row] & ~away
        return self._replace(there=there)


def nonlinear_unknowns(example: Example, levels: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """Return in which of the derivatives `levels` of the `unknowns`, which are changed together, each
    equation is nonlinear: shape `(n, number)`."""
    n, number = example.equations.n, len(levels)
    leading = jnp.zeros(number, example.jets[0].dtype)

    def residual(w: Array, t: Array, jets: tuple[Array, ...], args: Any) -> Array:
        changed = []
        for k, x in enumerate(jets):
            index, here = np.arange(n), levels == k
            index[unknowns[here]] = n + np.nonzero(here)[0]
            changed.append(pick(jnp.concatenate([x, w]), index))
        return example.residual(t, tuple(changed), args)

    def rate(w: Array, dw: Array, t: Array, jets: tuple[Array, ...], args: Any) -> Array:
        return jax.jvp(lambda w: residual(w, t, jets, args), (w,), (dw,))[1]

    others = (leading, example.t, example.jets, example.args)
    nothing = np.zeros(number, bool)
    inputs = (leading, np.eye(number, dtype=bool)), *(tracked(tree, nothing) for tree in others)
    return incidence(rate, *inputs).depends
