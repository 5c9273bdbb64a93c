"""Jacobians with a known pattern from few directional derivatives."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
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
    places: (
        sp.csr_array
    )  # of the entries in the flat derivatives, counted from 1: 0 stands for no entry

    @staticmethod
    def of(
        structure: DAEStructure, aliases: Aliases, there: np.ndarray, levels: int
    ) -> "Compressed":
        """Color the columns; `there` is the occurrence of the equations and unknowns that are left."""
        rows, columns = np.nonzero(structure.leading)
        orders = structure.sigma[rows, columns]
        pairs, which = np.unique(np.stack([orders, columns], 1), axis=0, return_inverse=True)
        which = which.ravel()
        shape = len(structure.c), len(pairs)
        needed = sp.csr_array((np.ones(len(rows), int), (rows, which)), shape)
        met = sp.csr_array(there[:, pairs[:, 0], pairs[:, 1]].astype(int))
        colors = greedy_colors(needed.T @ met, most_conflicts_first=True)
        n, members = len(aliases.root), [[] for _ in aliases.roots]
        for unknown, column in enumerate(aliases.columns.tolist()):
            members[column].append(unknown)
        seeds = np.zeros((int(colors.max(initial=-1)) + 1, levels, n))
        for (order, column), color in zip(pairs.tolist(), colors.tolist(), strict=True):
            for unknown in members[column]:
                level = order - aliases.shift[unknown]
                if 0 <= level < levels:
                    seeds[color, level, unknown] = aliases.factor[unknown]
        numbers = colors[which] * n + aliases.rows[rows] + 1
        return Compressed(seeds, sp.csr_array((numbers, (rows, columns)), structure.sigma.shape))

    def derivatives(self, function: Any, t: Array, jets: tuple[Array, ...], args: Args) -> Array:
        """Return the flat array of directional derivatives, of which the entries are taken."""
        seeds = tuple(jnp.asarray(self.seeds[:, k], jets[0].dtype) for k in range(len(jets)))
        at = lambda jets: function(t, jets, args)
        along = lambda *rates: jax.jvp(at, (jets,), (rates,))[1]
        return jax.vmap(along)(*seeds).ravel()

    def values(self, derivatives: Array) -> Array:
        """Return the values of the entries, row by row, in the order of `places`."""
        return pick(derivatives, self.places.data - 1)

    def block(self, derivatives: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
        places = self.places[rows][:, columns].toarray() - 1
        return pick(derivatives, places.ravel()).reshape(places.shape)

    def diagonal(self, derivatives: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
        return pick(derivatives, self.places[rows][:, columns].diagonal() - 1)

    def matrix(self, derivatives: Array) -> Array:
        every = np.arange(len(self.places.indptr) - 1)
        return self.block(derivatives, every, every)
