"""The rows of a matrix: an array, or a linear map without its entries."""

import abc
from typing import Any, Protocol, runtime_checkable, TYPE_CHECKING, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from .dense import gram, UNROLL_LIMIT


@runtime_checkable
class Metric(Protocol):
    """A symmetric matrix `W` with a method that solves its systems."""

    def solve(self, rows: Float[Array, "*k n"]) -> Float[Array, "*k n"]: ...


class AbstractRows(eqx.Module):
    """Rows `C` of shape `(m, n)` that are not held as an array."""

    @abc.abstractmethod
    def multiply(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """`C x`."""

    @abc.abstractmethod
    def combine(self, weights: Float[Array, " m"]) -> Float[Array, " n"]:
        """`C^T weights`."""

    @abc.abstractmethod
    def sizes(self, scale: Float[Array, " n"]) -> Float[Array, " m"]:
        """`max_j |C_ij| scale_j` with positive scales."""

    @abc.abstractmethod
    def along(self, metric: Metric) -> "AbstractRows":
        """`C W^-1`."""

    @abc.abstractmethod
    def factorize(self, directions: "AbstractRows", checked: bool = True) -> Any:
        """Factor `C V`, given the rows of `V^T`. The result has `solve(b)` and `usable`. Unless it is
        `checked`, test residuals of solutions instead with its `solves(residual, size2)`."""

    @abc.abstractmethod
    def of_other(self, function: Any, t: Array, x: Float[Array, " n"], args: Any) -> "AbstractRows":
        """Return the rows for `function(t, x, args)` at `x`, which has the same structure."""


# Largest number of rows whose sum is written out. XLA copies such a sum into every kernel that needs it: for
# the gradient of a four-bar linkage (eight rows) as reductions they take 0.7 of the time to compile and 0.93 of
# that to run (jaxlib 0.12.0.1), in a batch of 256 solves 1.04 of it; below five rows there is no difference.
_MOST_WRITTEN_OUT = 4


class InverseWeights(eqx.Module):
    """A diagonal metric, given by its inverse."""

    weights: Float[Array, " n"]

    def solve(self, rows: Float[Array, "*k n"]) -> Float[Array, "*k n"]:
        return rows * jnp.broadcast_to(self.weights, rows.shape)


if TYPE_CHECKING:
    Rows: TypeAlias = Any  # code that knows that rows are an array uses them as one
else:
    Rows: TypeAlias = Inexact[Array, "_ _"] | AbstractRows


def directions_of(metric: Metric, C: Rows) -> Rows:
    """Return the rows of `V^T = C W^-1`."""
    return C.along(metric) if isinstance(C, AbstractRows) else metric.solve(C)


def combine(weights: Inexact[Array, " m"], rows: Rows) -> Inexact[Array, " n"]:
    """`sum_i weights_i rows_i`."""
    if isinstance(rows, AbstractRows):
        return rows.combine(weights)
    if rows.shape[0] > UNROLL_LIMIT:
        return weights @ rows
    if not 1 <= rows.shape[0] <= _MOST_WRITTEN_OUT:
        return jnp.sum(weights[:, None] * rows, axis=0)
    return sum(weights[i] * rows[i] for i in range(rows.shape[0]))  # pyright: ignore[reportReturnType]


def multiply(A: Rows, x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return `A x`, without the library for small `A`, whose batched small products are slow."""
    if isinstance(A, AbstractRows):
        return A.multiply(x)
    if A.shape[1] > UNROLL_LIMIT:
        return gram(A, x[None, :])[:, 0]
    return combine(x, A.T)


def product(M: Float[Array, "..."], v: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return `M v` for a scalar, a diagonal, a matrix, or the blocks `(b, d, d)` on its diagonal."""
    if M.ndim < 2:
        return M * v
    if M.ndim == 2:
        return multiply(M, v)
    return jnp.sum(M * v.reshape(M.shape[0], 1, -1), axis=-1).reshape(-1)
