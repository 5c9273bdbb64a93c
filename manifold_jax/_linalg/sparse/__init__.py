"""Jacobians of many rows at linear cost: their sparsity, products without the matrix, and the
elimination of block tridiagonal matrices."""

from .rows import SparseRows as SparseRows
from .structure import (
    check_choice as check_choice,
    Choice as Choice,
    choose_structure as choose_structure,
    Structure as Structure,
    structure_of as structure_of,
)
