"""Samples of the matrix of the leading derivatives, to decide whether it is nonsingular."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array

from .._linalg.condition import equilibrated, reciprocal_condition, singular_below
from .layout import StateLayout
from .occurrence import Example


# Distance from the example, relative and absolute; smaller where the equations are not defined.
_DISTANCES = (0.5, 0.5, 0.5, 0.1, 0.01, 1e-3)


class Samples(NamedTuple):
    """Matrices, and the reciprocal condition of each."""

    matrices: list[sp.csr_array]
    conditions: list[float]

    @property
    def singular(self) -> bool:
        return max(self.conditions) < singular_below(self.matrices[0].dtype)

    @staticmethod
    def of(
        entries: Callable, places: sp.csr_array, example: Example, layout: StateLayout
    ) -> "Samples":
        """Take samples of `entries(t, y, args)`, those of a matrix at these places; `y` has the states and
        then the leading derivatives."""
        matrices = []
        for t, y in _points(layout, np.asarray(example.jets[0])):
            sample = np.asarray(entries(t, jnp.asarray(y), example.args))
            if np.isfinite(sample).all():
                matrix = sp.csr_array((sample, places.indices, places.indptr), places.shape)
                matrices.append(matrix)
        if not matrices:
            raise ValueError(
                "`F` or its derivatives are not finite near `x_example` (with random numbers for its derivatives). Give "
                "an example where F is defined, and parameters in `args_example` as they will be used."
            )
        return Samples(matrices, [reciprocal_condition(matrix) for matrix in matrices])


def _points(layout: StateLayout, x: np.ndarray) -> list[tuple[Array, np.ndarray]]:
    random = np.random.default_rng(0)
    order, unknown = np.concatenate([layout.names, layout.leading_names()]).T
    found = []
    for distance in _DISTANCES:
        z = np.where(order == 0, x[unknown], 0)
        z = z + np.where(order == 0, distance * (1 + np.abs(z)), 1) * random.normal(size=z.shape)
        found.append((jnp.asarray(random.uniform(), x.dtype), z.astype(x.dtype)))
    return found


def dependent_rows(matrix: sp.csr_array) -> np.ndarray:
    """Return the rows of a singular matrix that are part of the linear dependence."""
    left, values, _ = np.linalg.svd(equilibrated(matrix).toarray())
    null = left[:, values <= 1e3 * singular_below(matrix.dtype) * values[0]]
    return np.nonzero(np.abs(null).max(axis=1, initial=0) > 1e-6)[0]
