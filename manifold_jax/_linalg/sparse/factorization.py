"""The matrix `G V` of sparse rows, formed from products and factored."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._base.types import BoolScalar, FloatScalar
from ..newton import without_derivative
from ..rows import AbstractRows
from .block_order import BlockOrder
from .elimination import Blocks, eliminate
from .structure import Structure


class BlockFactorization(eqx.Module):
    """A factorization that is usable if a system with a known solution is solved to some digits: not if
    the rank is not full, nor if an entry is missing in the structure.

    The derivative is that of `G V x = b`, not of the elimination.
    """

    rows: AbstractRows
    directions: AbstractRows
    blocks: Blocks  # held fixed, as are the fields below
    eliminated: Any
    structure: Structure = eqx.field(static=True)
    symmetric: bool = eqx.field(static=True)
    usable: BoolScalar

    @staticmethod
    def of(
        rows, directions, structure: Structure, symmetric: bool, checked: bool
    ) -> "BlockFactorization":
        fixed_rows, fixed_directions = without_derivative((rows, directions))
        product = lambda z: fixed_rows.multiply(fixed_directions.combine(z))
        blocks = _blocks(product, structure, fixed_rows.x.dtype)
        factorization = BlockFactorization(
            rows, directions, blocks, eliminate(blocks), structure, symmetric, jnp.asarray(True)
        )
        if not checked:
            return factorization
        return dataclasses.replace(factorization, usable=factorization._is_right(product))

    def solve(self, b: Float[Array, " m"]) -> Float[Array, " m"]:
        solve = lambda multiply, b: self._refined(self.eliminated, multiply, b)
        transposed = lambda multiply, b: self._refined(
            eliminate(self.blocks.transposed()), multiply, b
        )
        return jax.lax.custom_linear_solve(
            lambda z: self.rows.multiply(self.directions.combine(z)),
            b,
            solve,
            solve if self.symmetric else transposed,
        )

    def _refined(self, eliminated: Any, multiply: Any, b: Float[Array, " m"]) -> Float[Array, " m"]:
        """Solve with one step of iterative refinement: the products of `multiply` are more accurate
        than the rounded entries of the matrix, and near singular positions that recovers a third of the
        digits. Not done for tridiagonal matrices."""
        x = solve_in_blocks(self.structure.block_order, eliminated, b)
        if self.structure.block_order.width == 1:
            return x
        return x + solve_in_blocks(self.structure.block_order, eliminated, b - multiply(x))

    def solves(self, residual: Float[Array, " m"], size2: FloatScalar) -> BoolScalar:
        """Whether a refinement `x' = A^-1 r` would be small: `r . x' = x' . A x'` compared with
        `x . A x` of the solutions, `size2`. If so, the rank is full, no entry is missing, and `A` is
        not too ill conditioned for the elimination, or else `A x = b` nevertheless."""
        r = jax.lax.stop_gradient(residual)
        change2 = jnp.abs(
            jnp.dot(r, solve_in_blocks(self.structure.block_order, self.eliminated, r))
        )
        tolerance = float(jnp.finfo(r.dtype).eps) ** (1 / 3)
        return change2 <= tolerance**2 * jax.lax.stop_gradient(size2)

    @property
    def lengths(self) -> Float[Array, " m"]:
        """Return the lengths of the gradients, in the metric of the directions."""
        diagonal = jnp.diagonal(self.blocks.diagonal, axis1=1, axis2=2)
        diagonal = self.structure.block_order.out_of_blocks(diagonal)
        return jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))

    def _is_right(self, product: Any) -> BoolScalar:
        """Solve a system with a known solution, scaled to be independent of the units of the equations."""
        lengths = self.lengths
        mixed = jnp.arange(lengths.size, dtype=jnp.uint32) * jnp.uint32(2654435769)
        known = jnp.where(mixed >> 31 == 0, 1, -1).astype(lengths.dtype)  # signs without a pattern
        solution = self._refined(self.eliminated, product, product(known / lengths))
        error = jnp.max(jnp.abs(solution * lengths - known))
        # Without full rank the error is as large as the solution. Long chains are ill conditioned, so
        # the tolerance is loose, above all in single precision: 1e-4 (2e-2).
        return error <= float(jnp.finfo(lengths.dtype).eps) ** (1 / 4)


def _blocks(product: Any, structure: Structure, dtype: Any) -> Blocks:
    """Compute one column of every third block at a time: blocks of the same one of three colors have no
    rows in common."""
    order = structure.block_order
    width, groups, places = order.width, order.num_blocks // 3, order.places
    wanted = jnp.arange(3 * width, dtype=jnp.int32)[:, None]
    column = (places // width) % 3 * width + places % width
    products = jax.vmap(product)((column[None, :] == wanted).astype(dtype))
    products = jnp.pad(order.ordered(products.T), ((0, order.num_padded), (0, 0)))
    entries = products.reshape(groups, 3, width, 3, width)  # block, row; color, column
    beside = lambda shift: jnp.stack(
        [entries[:, r, :, (r + shift) % 3, :] for r in range(3)], axis=1
    ).reshape(3 * groups, width, width)
    is_padding = (jnp.arange(3 * groups * width) >= order.size).astype(dtype)
    diagonal = beside(0) + jax.vmap(jnp.diag)(is_padding.reshape(-1, width))
    return Blocks(beside(-1), diagonal, beside(1))


def solve_in_blocks(
    order: BlockOrder, eliminated: Any, b: Float[Array, " m"]
) -> Float[Array, " m"]:
    return order.out_of_blocks(eliminated.solve(order.in_blocks(b)))
