"""Jacobians with a known pattern from few directional derivatives."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.types import Args
from .._linalg.coloring import greedy_colors
from .aliases import Aliases
from .derivatives import pick
from .signature import DAEStructure


class Compressed(NamedTuple):
    """The matrix `J_ij = dF_i^(c_i) / dx_j^(d_j) = dF_i / dx_j^(d_j - c_i)` of the equations and
    unknowns that are left; its entries are those of derivatives along the `seeds`."""

    seeds: np.ndarray  # (colors, levels, n)
    places: np.ndarray  # (rows, columns) in the flat derivatives, -1 for zero

    @staticmethod
    def of(
        structure: DAEStructure, aliases: Aliases, there: np.ndarray, levels: int
    ) -> "Compressed":
        """Color the columns; `there` is the occurrence of the equations and unknowns that are left."""
        rows, columns = np.nonzero(structure.leading)
        orders = structure.sigma[rows, columns]
        pairs, which = np.unique(np.stack([orders, columns], 1), axis=0, return_inverse=True)
        which = which.ravel()
        needed = np.zeros((len(structure.c), len(pairs)))
        needed[rows, which] = 1
        met = there[:, pairs[:, 0], pairs[:, 1]].astype(float)
        colors = greedy_colors(needed.T @ met > 0, most_conflicts_first=True)
        seeds = np.zeros((int(colors.max(initial=-1)) + 1, levels, len(aliases.root)))
        for (order, column), color in zip(pairs, colors, strict=True):
            for unknown in np.nonzero(aliases.columns == column)[0]:
                level = order - aliases.shift[unknown]
                if 0 <= level < levels:
                    seeds[color, level, unknown] = aliases.factor[unknown]
        places = np.full(structure.sigma.shape, -1)
        places[rows, columns] = colors[which] * len(aliases.root) + aliases.rows[rows]
        return Compressed(seeds, places)

    def derivatives(self, function: Any, t: Array, jets: tuple[Array, ...], args: Args) -> Array:
        """Return the flat array of directional derivatives, of which the entries are taken."""
        seeds = tuple(jnp.asarray(self.seeds[:, k], jets[0].dtype) for k in range(len(jets)))
        at = lambda jets: function(t, jets, args)
        along = lambda *rates: jax.jvp(at, (jets,), (rates,))[1]
        return jax.vmap(along)(*seeds).ravel()

    def block(self, derivatives: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
        places = self.places[np.ix_(rows, columns)]
        return pick(derivatives, places.ravel()).reshape(places.shape)

    def diagonal(self, derivatives: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
        return pick(derivatives, self.places[rows, columns])

    def matrix(self, derivatives: Array) -> Array:
        return self.block(derivatives, *map(np.arange, self.places.shape))
