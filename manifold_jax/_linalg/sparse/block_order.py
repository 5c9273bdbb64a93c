"""The order of the rows of a matrix in which it is block tridiagonal."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float
from scipy.sparse.csgraph import reverse_cuthill_mckee


class BlockOrder(NamedTuple):
    """An order of `size` rows and columns in which they form a block tridiagonal matrix.

    - `order`: the numbers of the rows in that order; `None` if it is their own.
    - `width`: the size of the blocks.
    """

    size: int
    order: np.ndarray | None
    width: int

    @staticmethod
    def best(coupled: sp.coo_matrix) -> "BlockOrder":
        """Return the given order, or that of Cuthill and McKee (Proc. 24th ACM Nat. Conf. (1969) 157-172)
        if the blocks are smaller; `coupled` is a symmetric pattern."""
        size: int = coupled.shape[0]  # pyright: ignore[reportOptionalSubscript]
        order = np.asarray(reverse_cuthill_mckee(coupled.tocsr(), symmetric_mode=True))
        given, reordered = _width(coupled, np.arange(size)), _width(coupled, np.argsort(order))
        return BlockOrder(size, *((None, given) if given <= reordered else (order, reordered)))

    @property
    def num_blocks(self) -> int:
        """Return the number of blocks, rounded up to a multiple of three, for three colors."""
        return 3 * -(-self.size // (3 * self.width))

    @property
    def num_padded(self) -> int:
        """Return the number of rows that complete the last blocks."""
        return self.num_blocks * self.width - self.size

    @property
    def own_places(self) -> np.ndarray:
        """Return the place of each row in the order."""
        places = np.arange(self.size) if self.order is None else np.argsort(self.order)
        return places.astype(np.int32)

    @property
    def places(self) -> Array:
        """Return the same for programs. A barrier keeps the compiler from evaluating all that depends on
        them at compile time, slowly."""
        return jax.lax.optimization_barrier(jnp.asarray(self.own_places))

    def ordered(self, b: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
        if self.order is None:
            return b
        return b[jax.lax.optimization_barrier(jnp.asarray(self.order))]

    def in_blocks(self, b: Float[Array, " m"]) -> Float[Array, "b w"]:
        return jnp.pad(self.ordered(b), (0, self.num_padded)).reshape(-1, self.width)

    def out_of_blocks(self, z: Float[Array, "b w"]) -> Float[Array, " m"]:
        z = z.reshape(-1)[: self.size]
        return z if self.order is None else z[self.places]


def _width(coupled: sp.coo_matrix, place: np.ndarray) -> int:
    """Return the smallest size of blocks for which the matrix is block tridiagonal."""
    i, j = place[coupled.row], place[coupled.col]
    band = max(1, int(np.abs(i - j).max(initial=1)))
    fits = lambda width: np.abs(i // width - j // width).max(initial=0) <= 1
    return next(width for width in range((band + 1) // 2, band + 1) if fits(width))
