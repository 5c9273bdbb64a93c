"""Jacobians of many rows at linear cost: their sparsity, products without the matrix, the elimination
of block tridiagonal matrices, and square matrices by their entries."""

from .direct import factorize_sparse as factorize_sparse, Method as Method
from .method import (
    SMALLEST as SMALLEST,
    SMALLEST_KLU as SMALLEST_KLU,
    Sparsity as Sparsity,
    sparsity_of_any as sparsity_of_any,
)
from .pattern import dependence as dependence
from .rows import SparseRows as SparseRows
from .square import SparseMatrix as SparseMatrix, SquarePattern as SquarePattern
from .structure import (
    check_choice as check_choice,
    Choice as Choice,
    choose_structure as choose_structure,
    program_of as program_of,
    Structure as Structure,
    structure_of as structure_of,
)
