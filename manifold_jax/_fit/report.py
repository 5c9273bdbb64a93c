"""The result of a fit: parameters, how well the data determine them, a text and a picture."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.tree_util as jtu
import numpy as np


class FitResult(eqx.Module):
    """What [`fit`][] found. Arrays are NumPy's; `print(result)` is a report.

    - `parameters`: the estimates, in the structure of the start values.
    - `standard_errors`: likewise; infinite where the data do not determine a parameter, `None`
        with a `loss` of one's own or reverse mode.
    - `covariance`: of the parameters in the order of `names`, shape `(p, p)`, or `None`.
    - `names`: of all numbers in `parameters`, e.g. `"masses[0]"`.
    - `y0`: the initial states, also where they are not fitted; with a leading axis of records
        if there are many.
    - `noise`: the standard deviation of a measurement estimated from the residuals: in units of
        `sigma` (about 1 if the model is right and `sigma` too), or in those of the data if
        `sigma` was not given. `None` where no data are left to estimate it.
    - `prediction`, `residuals`: like `data`; residuals are prediction minus data, not weighted, and
        NaN where a value is missing or the solve failed.
    - `history`: the loss before each step, shape `(steps,)`.
    - `failed`: for each record, whether its solve fails with the final parameters. It then has no
        influence on the estimates.
    - `unidentifiable`: one line for each direction that the data do not determine.
    - `at_bounds`: names of the parameters that ended at a bound; their errors mean nothing.
    - `success`, `message`: whether and how the optimizer ended well.
    """

    parameters: Any
    standard_errors: Any
    covariance: Any
    names: tuple[str, ...]
    y0: Any
    noise: float | None
    ts: Any
    prediction: Any
    residuals: Any
    history: Any
    failed: Any
    unidentifiable: tuple[str, ...]
    at_bounds: tuple[str, ...]
    success: bool
    message: str

    def __str__(self) -> str:
        steps = len(self.history)
        lines = [f"{'fitted' if self.success else 'NOT FITTED'}: {self.message} ({steps} steps)"]
        errors = self.standard_errors
        sizes = [None] * len(self.names) if errors is None else _flat(errors)
        for name, value, size in zip(self.names, _flat(self.parameters), sizes, strict=True):
            lines.append(f"  {name:24s} {value:.8g}" + ("" if size is None else f" +- {size:.2g}"))
        if self.noise is not None:
            lines.append(f"noise estimated from the residuals: {self.noise:.3g}")
        if np.any(self.failed):
            records = ", ".join(map(str, np.flatnonzero(self.failed)))
            lines.append(f"no influence, because their solve fails: records {records}")
        lines += [f"not determined by the data: {line}" for line in self.unidentifiable]
        lines += [f"at a bound: {name}" for name in self.at_bounds]
        return "\n".join(lines)

    def plot(self, path: str | Path | None = None) -> Any:
        """Data and prediction of the first records, their residuals, and the loss by steps.

        **Arguments:**

        - `path`: where to save it, e.g. `"fit.png"`.

        **Returns:**

        The Matplotlib figure.
        """
        from matplotlib.figure import Figure  # a second that only pictures need

        figure = Figure(figsize=(12, 4), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        for ts, prediction, residuals in self._curves():
            line = left.plot(ts, prediction, linewidth=1)[0]
            left.plot(ts, prediction - residuals, ".", markersize=3, color=line.get_color())
            middle.plot(ts, residuals, ".", markersize=3, color=line.get_color())
        left.set(title="data and prediction", xlabel="time")
        middle.set(title="prediction minus data", xlabel="time")
        right.plot(self.history)
        right.set(title="loss", xlabel="step", yscale="log")
        if path is not None:
            figure.savefig(path, dpi=150)
        return figure

    def _curves(self) -> Any:
        """Up to eight components over time, of the first record and then of others."""
        many = np.ndim(self.ts) == 2
        ts = np.atleast_2d(self.ts)
        shape = lambda leaf: np.reshape(leaf, (*ts.shape, -1))
        leaves = zip(*map(jtu.tree_leaves, (self.prediction, self.residuals)), strict=True)
        parts = [(shape(a), shape(b)) for a, b in leaves]
        found = [
            (ts[r], a[r, :, k], b[r, :, k])
            for r in range(len(ts) if many else 1)
            for a, b in parts
            for k in range(a.shape[2])
        ]
        return found[:8]


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(tree)])
