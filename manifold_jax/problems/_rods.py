"""Point masses on rigid rods: equations, reference solutions, and velocities that rods allow."""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ._problem import integrate


Force: TypeAlias = Callable[[np.ndarray], np.ndarray]


class Rods(NamedTuple):
    """Rods between the points `start[i]` and `end[i]`, and `A = J M^-1 J^T` of their equations
    `|d_i|^2 / 2 = const.`, a banded matrix: `A[i, j] = weight d_i . d_j` for each of the pairs."""

    start: np.ndarray
    end: np.ndarray
    inverse_masses: np.ndarray  # of the points; 0 for fixed ones
    i: np.ndarray
    j: np.ndarray
    weight: np.ndarray

    @staticmethod
    def between(start: np.ndarray, end: np.ndarray, inverse_masses: np.ndarray) -> "Rods":
        number, points = start.size, inverse_masses.size
        where = np.tile(np.arange(number), 2), np.concatenate([start, end])
        signs = np.repeat([-1.0, 1.0], number)
        touches = sp.csr_matrix((signs, where), (number, points))
        order = reverse_cuthill_mckee(sp.csr_matrix(abs(touches) @ abs(touches).T))
        touches = touches[order]
        pairs = sp.coo_matrix(sp.tril(touches @ sp.diags(inverse_masses) @ touches.T))
        return Rods(start[order], end[order], inverse_masses, pairs.row, pairs.col, pairs.data)

    def vectors(self, points: np.ndarray) -> np.ndarray:
        return points[self.end] - points[self.start]

    def along(self, d: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return `M^-1 J^T A^-1 b` at vectors `d` along the rods: the smallest velocities, in the
        metric of the masses, with `d . d' = b` for each rod."""
        bands = np.zeros((int((self.i - self.j).max()) + 1, len(d)))
        products = np.einsum("kd,kd->k", d[self.i], d[self.j])
        bands[self.i - self.j, self.j] = self.weight * products
        solved = scipy.linalg.solveh_banded(bands, b, lower=True, check_finite=False)
        pull = solved[:, None] * d
        rates = np.zeros((self.inverse_masses.size, d.shape[1]))
        np.add.at(rates, self.end, pull)
        np.subtract.at(rates, self.start, pull)
        return self.inverse_masses[:, None] * rates


def equal_masses(q: Any, args: Any) -> Array:
    return jnp.broadcast_to(args.mass, q.shape)


def stretch(d: Any, length2: Any) -> Array:
    """Return the residual of rods `d`, `(..., dimensions)`, with the squares of their lengths
    `length2`. Not as a sum over an axis, for which XLA would call a library."""
    parts = [d[..., i] for i in range(d.shape[-1])]
    return 0.5 * (functools.reduce(operator.add, [x * x for x in parts]) - length2)


def allowed(rods: Rods, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the velocities nearest to `v` with rods of constant length."""
    d = rods.vectors(q)
    return v - rods.along(d, np.einsum("kd,kd->k", d, rods.vectors(v)))


def rod_field(
    rods: Rods, force: Force, dimensions: int
) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return `x' = field(t, x)` for `x` of positions and velocities, under forces `force(q)`."""
    shape = rods.inverse_masses.size, dimensions

    def field(_: float, x: np.ndarray) -> np.ndarray:
        q, v = x.reshape(2, *shape)
        d, rate = rods.vectors(q), rods.vectors(v)
        free = rods.inverse_masses[:, None] * force(q)
        right = np.einsum("kd,kd->k", d, rods.vectors(free)) + np.einsum("kd,kd->k", rate, rate)
        return np.concatenate([v, free - rods.along(d, right)]).reshape(-1)

    return field


def solve_rods(
    rods: Rods, force: Force, t: np.ndarray, q: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities at times `t`, from those at time 0, of shape `(points, d)`.
    Nothing is projected: rods keep their lengths to the accuracy of the integration."""
    x0 = np.concatenate([q, v]).reshape(-1)
    states = integrate(rod_field(rods, force, q.shape[1]), x0, t).reshape(t.size, 2, *q.shape)
    return states[:, 0], states[:, 1]
