"""What an ensemble returns."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax import RESULTS
from jaxtyping import Array, PyTree

from .._compat import is_okay, messages_of_results, number_of_result


class EnsembleSolution(eqx.Module):
    """Of `N` trajectories, in the order of the initial values.

    - `ts`: the times of what was saved, `(N, T)`; infinite where a trajectory did not get there, and with
      `SaveAt(t1=True)` the time at which it stopped: see `failed`.
    - `ys`: the saved values, `(N, T, ...)`.
    - `stats`: as of [`diffeqsolve`][] without `max_steps`, each of shape `(N,)`.
    - `result`: the result codes of all trajectories.
    - `execution`: "in lanes", or why not.
    """

    ts: PyTree[Array]
    ys: PyTree[Array]
    stats: dict[str, Any]
    result: RESULTS
    execution: str = eqx.field(static=True, default="in lanes")

    @property
    def failed(self) -> Array:
        """Which trajectories did not get to their end, shape `(N,)`."""
        return ~jax.vmap(is_okay)(self.result)

    def failures(self, most: int = 10) -> list[tuple[int, str]]:
        """Numbers and reasons of the first that failed; not under `jit`. Of several processes each
        lists those of its own devices."""
        codes, messages = jnp.asarray(number_of_result(self.result)), messages_of_results()
        successful, failed = number_of_result(RESULTS.successful), {}
        for shard in codes.addressable_shards:
            part = np.asarray(shard.data)
            first = shard.index[0].start or 0
            failed |= {
                first + int(i): messages[part[i]] for i in np.flatnonzero(part != successful)
            }
        return sorted(failed.items())[:most]
