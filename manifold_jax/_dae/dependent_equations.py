"""What a singular matrix of the leading derivatives says, in names."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from .._base.errors import listed
from .analysis import Analysis
from .samples import dependent_rows


class DependentEquations(NamedTuple):
    """The equations that depend on each other; of a single one, whose row is zero, also the leading
    derivatives in it. Names, as they are listed in messages."""

    equations: str
    vanishing: str

    @staticmethod
    def of(analysis: Analysis, matrix: sp.csr_array) -> "DependentEquations":
        names, rows = analysis.example.equations.names, dependent_rows(matrix)
        equations = listed([names.equations[i] for i in analysis.rows[rows]])
        if len(rows) != 1:
            return DependentEquations(equations, "")
        row, columns = analysis.entries.places.nonzero()
        leading = analysis.layout.leading_names()[columns[np.isin(row, rows)]].tolist()
        return DependentEquations(equations, listed([names.derivative(j, k) for k, j in leading]))
