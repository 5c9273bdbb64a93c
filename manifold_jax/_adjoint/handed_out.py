"""What has derivatives of a solve."""

from typing import Any, NamedTuple

from .._compat import Differentiable, LoopState
from .replay import memory_of, State, with_memory


class HandedOut(NamedTuple):
    """What has derivatives of the final state of a loop, of the solver's state what steps depend
    on."""

    ts: list[Any]
    ys: list[Any]
    dense_ts: Any
    dense_infos: Any
    event_dense_info: Any
    state: State

    @staticmethod
    def of(final_state: LoopState, remembers: bool) -> "HandedOut":
        of = Differentiable.of(final_state)
        memory = memory_of(of.solver_state) if remembers else None
        dense = of.dense_ts, of.dense_infos, of.event_dense_info
        return HandedOut(of.ts, of.ys, *dense, State(of.y, memory))

    def put_into(self, final_state: LoopState) -> LoopState:
        y, memory = self.state
        solver_state = Differentiable.of(final_state).solver_state
        if memory is not None:
            solver_state = with_memory(solver_state, memory)
        dense = self.dense_ts, self.dense_infos, self.event_dense_info
        return Differentiable(self.ts, self.ys, *dense, y, solver_state).put_into(final_state)
