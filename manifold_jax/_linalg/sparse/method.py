"""The method by which systems with a sparse matrix are solved."""

from typing import NamedTuple

import jax.numpy as jnp

from ..._base.klu import has_klu
from .direct import Method
from .square import SquarePattern


# Number of unknowns from which on sparse systems are solved as such. A step of the Brusselator with
# diffusion then takes 0.48 of the time with dense matrices (0.57 with 48, 0.51 with 96), of a ladder, which is
# tridiagonal, 0.47 (0.64, 0.21); to compile takes twice as long. jaxlib 0.10.2.
SMALLEST = 64
# The same for KLU: 1.7 and 1.4 times as long with 100 unknowns, 0.4 and 0.1 with 150.
SMALLEST_KLU = 128


class Sparsity(NamedTuple):
    """Where matrices have entries, and how their systems are solved."""

    pattern: SquarePattern
    method: Method


def sparsity_of_any(pattern: SquarePattern, dtype: jnp.dtype) -> Sparsity | None:
    """Return how systems with any nonsingular matrix of a pattern are solved, with exchanges of rows where
    they are needed; `None` for dense matrices."""
    if pattern.size < SMALLEST or pattern.transversal is None:
        return None
    if pattern.block_order.width == 1:
        return Sparsity(pattern, "tridiagonal")
    if pattern.size < SMALLEST_KLU or not has_klu(dtype):
        return None
    return Sparsity(pattern, "klu" if pattern.elimination_plan is None else "either")
