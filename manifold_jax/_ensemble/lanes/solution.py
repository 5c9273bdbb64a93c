"""The solution of an ensemble."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax import RESULTS
from jaxtyping import Array, PyTree

from ..._base.compat import is_okay, nonlinear_failure, number_of_result
from ..._resets.record import Resets
from ..._resets.reset import TIME_IS_NAN
from ..._solve.outcome import (
    is_unusable_start,
    is_without_time,
    messages_for,
    NO_TIME,
    NOT_FINITE_START,
    UNUSABLE_START,
)
from ..._solve.resets import NO_STATE_AFTER, TOO_MANY_RESETS


class EnsembleSolution(eqx.Module):
    """The solutions of `N` trajectories, in the order of the initial values.

    - `ts`: the times of saved values, `(N, T)`; infinite where a trajectory did not get there, and with
      `SaveAt(t1=True)` the time at which it stopped: see `failed`.
    - `ys`: the saved values, `(N, T, ...)`.
    - `stats`: as of [`diffeqsolve`][] without `max_steps`, each of shape `(N,)`.
    - `result`: the result codes of all trajectories.
    - `event_mask`: with `event`, which of its functions ended each trajectory; as of `diffrax.Solution`.
    - `resets`: with `resets`, those of all trajectories, a [`Resets`][] with the trajectories in front.
    - `execution`: "in lanes", or why not.
    - `messages`: those of the result codes, by number; the last three are for a trajectory without
        steps whose times or start could not be used.
    """

    ts: PyTree[Array]
    ys: PyTree[Array]
    stats: dict[str, Any]
    result: RESULTS
    event_mask: PyTree[Array] | None = None
    resets: Resets | None = None
    execution: str = eqx.field(static=True, default="in lanes")
    messages: tuple[str, ...] = eqx.field(static=True, default=(), repr=False)

    @property
    def failed(self) -> Array:
        """Whether each trajectory failed to reach its end, shape `(N,)`."""
        return ~jax.vmap(is_okay)(self.result)

    def reasons(self) -> Array:
        """Return numbers of `messages`, shape `(N,)`, 0 where a trajectory is successful."""
        codes = number_of_result(self.result)
        num_steps, last = self.stats["num_steps"], len(self.messages) - 1
        # A start that is not finite cannot be moved by a finite distance.
        moved = self.stats.get("initial_correction", jnp.zeros_like(num_steps, float))
        start = jnp.where(jnp.isnan(moved), last - 1, last)
        codes = jnp.where(is_without_time(codes, num_steps), last - 2, codes)
        codes = jnp.where(is_unusable_start(codes, num_steps), start, codes)
        return jnp.where(self.failed, codes, 0)

    def failures(self, most: int = 10) -> list[tuple[int, str]]:
        """Return indices and reasons of the first that failed; not under `jit`. Each of several
        processes lists those of its own devices."""
        reasons, failed = jnp.asarray(self.reasons()), {}
        for shard in reasons.addressable_shards:
            part = np.asarray(shard.data)
            first = shard.index[0].start or 0
            failed |= {first + int(i): self.messages[part[i]] for i in np.flatnonzero(part)}
        return sorted(failed.items())[:most]


def messages_of(solver: dfx.AbstractSolver, has_resets: bool) -> tuple[str, ...]:
    """Return the messages for the numbers of `EnsembleSolution.reasons`."""
    messages, no_time = messages_for(solver), NO_TIME
    if has_resets:
        no_time += f" Or: {TIME_IS_NAN}"
        more = (RESULTS.max_steps_reached, TOO_MANY_RESETS), (nonlinear_failure(), NO_STATE_AFTER)
        for result, text in more:
            messages[int(number_of_result(result))] += f" Or: {text}"
    return (*messages, no_time, NOT_FINITE_START, UNUSABLE_START)
