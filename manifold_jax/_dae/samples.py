"""Samples of the matrix of the leading derivatives, to decide whether it is nonsingular."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .layout import StateLayout
from .occurrence import Example


# Distance from the example, relative and absolute; smaller where the equations are not defined.
_DISTANCES = (0.5, 0.5, 0.5, 0.1, 0.01, 1e-3)


class Samples(NamedTuple):
    """Matrices, equilibrated, and the smallest over the largest singular value of each."""

    matrices: list[np.ndarray]
    conditions: list[float]

    @property
    def singular(self) -> bool:
        return max(self.conditions) < singular_below(self.matrices[0].dtype)

    @staticmethod
    def of(matrix: Callable, example: Example, layout: StateLayout) -> "Samples":
        """Take samples of `matrix(t, y, args)`; `y` has the states and then the leading derivatives."""
        matrices = []
        for t, y in _points(layout, np.asarray(example.jets[0])):
            sample = np.asarray(matrix(t, jnp.asarray(y), example.args))
            if np.isfinite(sample).all():
                matrices.append(sample)
        if not matrices:
            raise ValueError(
                "`F` or its derivatives are not finite near `x_example` (with random numbers for its derivatives). Give "
                "an example where F is defined, and parameters in `args_example` as they will be used."
            )
        return Samples(matrices, [condition(matrix) for matrix in matrices])


def singular_below(dtype: np.dtype) -> float:
    return float(np.finfo(dtype).eps) ** 0.75


def _points(layout: StateLayout, x: np.ndarray) -> list[tuple[Array, np.ndarray]]:
    random = np.random.default_rng(0)
    order, unknown = np.concatenate([layout.names, layout.leading_names()]).T
    found = []
    for distance in _DISTANCES:
        z = np.where(order == 0, x[unknown], 0)
        z = z + np.where(order == 0, distance * (1 + np.abs(z)), 1) * random.normal(size=z.shape)
        found.append((jnp.asarray(random.uniform(), x.dtype), z.astype(x.dtype)))
    return found


def equilibrated(matrix: np.ndarray) -> np.ndarray:
    for axis in (1, 0, 1, 0):
        size = np.abs(matrix).max(axis=axis, keepdims=True)
        matrix = matrix / np.where(size > 0, size, 1)
    return matrix


def condition(matrix: np.ndarray) -> float:
    if matrix.size == 0:
        return 1.0
    values = np.linalg.svd(equilibrated(matrix), compute_uv=False)
    return float(values[-1] / values[0]) if values[0] > 0 else 0.0


def dependent_rows(matrix: np.ndarray) -> np.ndarray:
    """Return the rows of a singular matrix that are part of the linear dependence."""
    left, values, _ = np.linalg.svd(equilibrated(matrix))
    null = left[:, values <= 1e3 * singular_below(matrix.dtype) * values[0]]
    return np.nonzero(np.abs(null).max(axis=1, initial=0) > 1e-6)[0]
