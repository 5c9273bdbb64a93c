"""Ends a solve before its first step if its state cannot be used."""

from typing import Any

import diffrax as dfx

from .._base.compat import LoopState, Progress, with_result
from .._base.rejection import result_of_state


class CheckedStartAdjoint(dfx.AbstractAdjoint):
    """Wraps the adjoint of a solve whose initial state may be NaN.

    The error relative to such a state is NaN, too, and an adaptive controller would reject all of
    `max_steps` steps.
    """

    adjoint: dfx.AbstractAdjoint

    def loop(self, *, init_state: LoopState, **kwargs: Any) -> Any:
        result = result_of_state(Progress.of(init_state).y)
        return self.adjoint.loop(init_state=with_result(init_state, result), **kwargs)
