"""The rows of a Jacobian as a linear map, without its entries."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._base.closure import convert_closure
from ..._base.types import Args
from ..rows import AbstractRows, Metric
from .factorization import BlockFactorization
from .structure import Structure


class SparseRows(AbstractRows):
    """`C = d function(t, x, args) / dx`, or the directions `C W^-1` with a symmetric metric `W`.

    Products are derivatives of the function along one vector, as cheap as the function itself.
    """

    function: Callable
    t: Array
    x: Float[Array, " n"]
    args: Args
    structure: Structure = eqx.field(static=True)
    metric: Metric | None = None

    @staticmethod
    def of(function: Callable, t, x, args, structure: Structure) -> "SparseRows":
        # Closed-over arrays become inputs, so that they are differentiated.
        function = convert_closure(function, t, x, args)
        return SparseRows(function, t, x, args, structure)

    def along(self, metric: Metric) -> "SparseRows":
        return SparseRows(self.function, self.t, self.x, self.args, self.structure, metric)

    def of_other(self, function, t, x, args) -> "SparseRows":
        return SparseRows.of(function, t, x, args, self.structure)

    def multiply(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        v = x if self.metric is None else self.metric.solve(x)
        return jax.jvp(self._values, (self.x,), (v,))[1]

    def combine(self, weights: Float[Array, " m"]) -> Float[Array, " n"]:
        _, pullback = jax.vjp(self._values, self.x)
        (v,) = pullback(weights)
        return v if self.metric is None else self.metric.solve(v)

    def sizes(self, scale: Float[Array, " n"]) -> Float[Array, " m"]:
        structure = self.structure
        colors = jax.lax.optimization_barrier(jnp.asarray(structure.color))
        seeds = jnp.arange(structure.num_colors, dtype=jnp.int32)[:, None] == colors[None, :]
        entries = jax.vmap(self.multiply)(jnp.where(seeds, scale[None, :], 0))
        return jnp.max(jnp.abs(entries), axis=0)

    def factorize(self, directions: "SparseRows", checked: bool = True) -> BlockFactorization:
        symmetric = directions.function is self.function and directions.x is self.x
        return BlockFactorization.of(self, directions, self.structure, symmetric, checked)

    def _values(self, x: Float[Array, " n"]) -> Any:
        return self.function(self.t, x, self.args)
