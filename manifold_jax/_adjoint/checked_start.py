"""Ends a solve before its first step if its state cannot be used."""

from typing import Any

import diffrax as dfx
import equinox as eqx

from .._base.compat import LoopState, Progress, with_result
from .._base.rejection import result_of_state


class CheckedStartAdjoint(dfx.AbstractAdjoint):
    """Wraps the adjoint of a solve whose initial state may be NaN.

    The error relative to such a state is NaN, too, and an adaptive controller would reject all of
    `max_steps` steps.
    """

    adjoint: dfx.AbstractAdjoint
    # Whether the user passed or asked for the state of the solver, which in any case is passed and saved.
    passes_solver_state: bool
    keeps_solver_state: bool

    def loop(self, *, init_state: LoopState, saveat: dfx.SaveAt, **kwargs: Any) -> Any:
        state = with_result(init_state, result_of_state(Progress.of(init_state).y))
        saveat = eqx.tree_at(lambda s: s.solver_state, saveat, self.keeps_solver_state)
        kwargs["passed_solver_state"] = self.passes_solver_state
        return self.adjoint.loop(init_state=state, saveat=saveat, **kwargs)
