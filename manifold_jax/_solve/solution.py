"""The solution of a differential equation on a manifold."""

from typing import Any

import diffrax as dfx

from .._resets.record import Resets


class Solution(dfx.Solution):
    """A `diffrax.Solution`, whose values are on the manifold.

    **Attributes:** those of `diffrax.Solution`, among them

    - `ts`, `ys`: the times and states that were saved, with a leading axis for the times.
    - `stats`: statistics, of which [`diffeqsolve`][] says which there are.
    - `result`: whether the solve succeeded.
    - `resets`: the jumps ([`Resets`][]) of a solve with `resets`, otherwise `None`.
    """

    # What was saved, whose type a checker does not know, and its interpolation, which is corrected.
    ts: Any
    ys: Any
    interpolation: Any
    resets: Any

    @staticmethod
    def of(sol: dfx.Solution, resets: Resets | None = None) -> "Solution":
        fields = {name: getattr(sol, name) for name in dfx.Solution.__dataclass_fields__}
        return Solution(**fields, resets=resets)
