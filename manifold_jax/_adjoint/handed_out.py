"""What has derivatives of a solve."""

from typing import Any, NamedTuple

import equinox as eqx

from .._compat import LoopState, save_states
from .replay import memory_of, State, with_memory


class HandedOut(NamedTuple):
    """What has derivatives of the final state of a loop: not its statistics, and not the state of
    the step size controller."""

    ts: list[Any]
    ys: list[Any]
    dense_ts: Any
    dense_infos: Any
    event_dense_info: Any
    state: State

    @staticmethod
    def of(final_state: LoopState, remembers: bool) -> "HandedOut":
        saved = save_states(final_state)
        memory = memory_of(final_state.solver_state) if remembers else None
        return HandedOut(
            [s.ts for s in saved],
            [s.ys for s in saved],
            final_state.dense_ts,
            final_state.dense_infos,
            final_state.event_dense_info,
            State(final_state.y, memory),
        )

    def put_into(self, final_state: LoopState) -> LoopState:
        put = lambda s, *new: eqx.tree_at(lambda s: (s.ts, s.ys), s, new, is_leaf=_is_none)
        saved = zip(save_states(final_state), self.ts, self.ys, strict=True)
        final_state = eqx.tree_at(save_states, final_state, [put(*of) for of in saved])
        parts = lambda s: (s.dense_ts, s.dense_infos, s.event_dense_info, s.y)
        new = self.dense_ts, self.dense_infos, self.event_dense_info, self.state.y
        final_state = eqx.tree_at(parts, final_state, new, is_leaf=_is_none)
        if self.state.memory is None:
            return final_state
        solver_state = with_memory(final_state.solver_state, self.state.memory)
        return eqx.tree_at(lambda s: s.solver_state, final_state, solver_state, is_leaf=_is_none)


def _is_none(x: Any) -> bool:
    return x is None
