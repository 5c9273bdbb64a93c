"""The places of numbers: derivatives of unknowns in the state, equations in the constraint."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .aliases import Aliases
from .derivatives import pick
from .signature import DAEStructure


class Gather(NamedTuple):
    """Maps vectors to `scale * (z, w)[index]`, zero where the index is negative."""

    index: np.ndarray
    scale: np.ndarray

    def __call__(self, z: Float[Array, " a"], w: Float[Array, " b"] | None) -> Float[Array, " n"]:
        """Apply the map; `w = None` stands for zeros."""
        source = z if w is None else jnp.concatenate([z, w])
        index = np.where(self.index < source.shape[0], self.index, -1)
        picked = pick(source, index)
        if (self.scale[index >= 0] == 1).all():
            return picked
        return picked * jnp.asarray(self.scale, z.dtype)


class StateLayout(NamedTuple):
    """The layout of the state `z`. `names` has for each of its numbers the derivative and the unknown
    whose name it has; `places` for each unknown that is left where its derivatives are: below `d_j` in
    `z`, and `x_j^(d_j)` in the leading derivatives `w`, which are counted after `z`."""

    structure: DAEStructure
    aliases: Aliases
    names: np.ndarray  # (states, 2): derivative, unknown
    places: np.ndarray  # (levels, roots)

    @property
    def num_states(self) -> int:
        return len(self.names)

    def leading_names(self) -> np.ndarray:
        """Return derivative and unknown for each leading derivative, by the name of lowest order."""
        found = []
        for j, root in enumerate(self.aliases.roots.tolist()):
            order = self.structure.d[j] - self.aliases.shift
            (names,) = np.nonzero((self.aliases.root == root) & (order >= 0))
            unknown = names[np.argmin(order[names])]
            found.append((order[unknown], unknown))
        return np.array(found, int).reshape(-1, 2)

    @staticmethod
    def of(structure: DAEStructure, aliases: Aliases, order: int) -> "StateLayout":
        """Put the user's own unknowns first, in their order, then derivatives without a name."""
        n, d = len(aliases.root), structure.d
        places = np.full((int(d.max(initial=0)) + 1, len(d)), -1)
        names, columns = [], aliases.columns
        for k in range(int(d.max(initial=0)) + 1):
            for unknown in range(n):
                m, j = k + aliases.shift[unknown], columns[unknown]
                if m < d[j] and places[m, j] < 0:
                    places[m, j] = len(names)
                    names.append((k, unknown))
        places[d, np.arange(len(d))] = len(names) + np.arange(len(d))
        return StateLayout(structure, aliases, np.array(names, int).reshape(-1, 2), places)

    def scale(self) -> np.ndarray:
        """The factor of each state relative to the derivative of its root."""
        return self.aliases.factor[self.names[:, 1]]

    def _scales(self) -> np.ndarray:
        return np.concatenate([self.scale(), np.ones(len(self.structure.d))])

    def jet(self, k: int, further: int = 0) -> Gather:
        """Return the map to derivative `k` of all unknowns, with `further` derivatives of `w` after it."""
        d, j = self.structure.d, self.aliases.columns
        level = k + self.aliases.shift
        inside = level < len(self.places)
        index = np.where(inside, self.places[np.where(inside, level, 0), j], -1)
        beyond = level - d[j]
        known = (beyond > 0) & (beyond <= further)
        index = np.where(known, self.num_states + beyond * len(d) + j, index)
        scales = np.concatenate([self._scales(), np.ones(further * len(d))])
        return Gather(index, self.aliases.factor / scales[index])

    def most_beyond(self, k: int) -> int:
        """Return how many derivatives of `w` derivative `k` of all unknowns requires."""
        highest = self.structure.d[self.aliases.columns]
        return max(0, int((k + self.aliases.shift - highest).max(initial=0)))

    def rate(self) -> Gather:
        """Return the map from `(z, w)` to the derivative of the state."""
        level, unknown = self.names.T
        index = self.places[level + self.aliases.shift[unknown] + 1, self.aliases.columns[unknown]]
        return Gather(index, self.scale() / self._scales()[index])
