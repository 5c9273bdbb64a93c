"""The condition of sparse matrices, whatever the units of equations and unknowns.

A matrix is nonsingular if the diagonal blocks of its block triangular form are: they have no order in
which a part of the equations could be solved first. A long chain of unknowns, each a multiple of the one
before, is no block of its own, while the singular values of the whole would span many decades.

Source: N. J. Higham & F. Tisseur, A block algorithm for matrix 1-norm estimation, SIAM J.
Matrix Anal. Appl. 21 (2000) 1185-1201.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, onenormest, splu

from .block_triangular import BlockTriangular


# Largest block of which the singular values are computed; of larger ones the condition is estimated.
_LARGEST_DENSE = 200


def singular_below(dtype: np.dtype) -> float:
    """Return the reciprocal condition below which a matrix counts as singular, and an entry as zero beside
    entries of size one."""
    return float(np.finfo(dtype).eps) ** 0.75


def equilibrated(matrix: sp.csr_array) -> sp.csr_array:
    """Return a matrix whose rows and columns have entries of size one at most."""
    for axis in (1, 0, 1, 0):
        size = abs(matrix).max(axis=axis).toarray().ravel()
        inverse = sp.diags_array(1 / np.where(size > 0, size, 1))
        matrix = sp.csr_array(inverse @ matrix if axis == 1 else matrix @ inverse)
    return matrix


def reciprocal_condition(matrix: Any) -> float:
    """Return, of a sparse matrix, the smallest reciprocal condition number of a diagonal block, in the 2-norm (an estimate in
    the 1-norm for large ones): one for a triangular matrix, zero for a singular one."""
    if matrix.shape[0] == 0:
        return 1.0
    matrix = equilibrated(matrix)
    matrix.data[abs(matrix.data) < singular_below(matrix.dtype)] = 0
    form = BlockTriangular.of(matrix)
    if form is None:
        return 0.0
    large = [part for part in form.blocks if len(part[0]) > 1]
    return min((_of_block(matrix[rows][:, columns]) for rows, columns in large), default=1.0)


def _of_block(block: Any) -> float:
    if block.shape[0] <= _LARGEST_DENSE:
        values = np.linalg.svd(block.toarray(), compute_uv=False)
        return float(values[-1] / values[0])
    try:
        factors = splu(sp.csc_array(block))
    except RuntimeError:  # exactly singular
        return 0.0
    transposed = lambda x: factors.solve(x, trans="T")
    inverse: Any = LinearOperator(block.shape, matvec=factors.solve, rmatvec=transposed)  # pyright: ignore[reportCallIssue]
    return float(1 / (abs(block).sum(axis=0).max() * onenormest(inverse)))
