"""Coordinates of hinges and sliders that are numbers of the state, and need not be read from poses of bodies."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


# Targets that files round to half a turn, such as 3.1416, are none beyond it.
HALF_TURN = np.pi + 1e-3


class KnownCoordinates(NamedTuple):
    """The coordinates of joints by name. Their angles continue beyond `pi`; those that are read from poses of bodies
    do not."""

    names: tuple[str, ...]
    values: Float[Array, " n"] | np.ndarray

    def instead_of(self, read: Float[Array, " k"], joints: tuple[str, ...]) -> Float[Array, " k"]:
        """Return the coordinates of `joints`, those that are not known as they were read."""
        places, numbers = self.find(joints)
        if len(places) == len(joints):
            return jnp.asarray(self.values)[numbers]
        return read.at[places].set(self.values[numbers]) if len(places) else read

    def find(self, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return which of `joints` are known, and their numbers."""
        number = {name: c for c, name in enumerate(self.names)}
        known = [(i, number[joint]) for i, joint in enumerate(joints) if joint in number]
        places, numbers = np.array(known, int).reshape(-1, 2).T
        return places, numbers


NONE_KNOWN = KnownCoordinates((), np.zeros(0))
