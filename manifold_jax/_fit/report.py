"""The result of a fit: parameters, their quality, a text and a picture."""

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu
import numpy as np
from scipy.special import chdtrc

from .._base.extras import require


# Wrong models are "rejected with vastly smaller values" (Press et al., Numerical Recipes, 15.1).
_LEAST_PROBABILITY = 1e-3
# Columns of the table of starts.
_MOST_NAMES = 6


class Start(NamedTuple):
    """One of several starts of [`fit`][] and its end: `start` and `parameters` in the structure of the
    parameters, the final loss, the number of steps, and `success` and `message` as in [`FitResult`][]."""

    start: Any
    parameters: Any
    loss: float
    steps: int
    success: bool
    message: str


class FitResult(eqx.Module):
    """The result of [`fit`][]. Arrays are NumPy's; `print(result)` is a report.

    - `parameters`: the estimates, in the structure of the start values.
    - `standard_errors`: likewise; infinite where the data do not determine a parameter, NaN for one at
        its bound (the others' are those with it held there), `None` with a `loss` of one's own or
        reverse mode. They hold for a model that fits.
    - `covariance`: of the parameters in the order of `names`, shape `(p, p)`, or `None`.
    - `names`: of all numbers in `parameters`, e.g. `"masses[0]"`.
    - `y0`: the initial states, also where they are not fitted; with a leading axis of records
        if there are many.
    - `noise`: the standard deviation of a measurement estimated from the residuals: in units of
        `sigma` (about 1 if the model is right and `sigma` too), or in those of the data if
        `sigma` was not given. `None` where no data are left to estimate it.
    - `chi_squared`, `degrees_of_freedom`: the sum of squared residuals in units of `sigma`, and the
        number of values it is made of less that of unknowns which they determine. `None` if `sigma`
        was not given (the size of the residuals then says nothing about the model), or with a
        `loss` of one's own. Likewise the properties `reduced_chi_squared`, their ratio (about 1 if
        the model is right and `sigma` too), `probability` of so large a `chi_squared` by noise alone,
        and `fits`: whether that is at least 0.001.
    - `prediction`, `residuals`: like `data`; residuals are prediction minus data, not weighted, and
        NaN where a value is missing or the solve failed.
    - `history`: the loss before each step, shape `(steps,)`.
    - `failed`: for each record, whether its solve fails with the final parameters. It then has no
        influence on the estimates.
    - `unidentifiable`: one line for each direction that the data do not determine, with the
        changes of the parameters along it, in their own units, of which the largest is 1.
    - `at_bounds`: names of the parameters that ended at a bound, beyond which the loss would be
        smaller.
    - `starts`: all starts, that of the result first, then by loss: a tuple of named tuples `start`,
        `parameters`, `loss`, `steps`, `success`, `message`.
    - `success`, `message`: whether and how the optimizer ended well.
    """

    parameters: Any
    standard_errors: Any
    covariance: Any
    names: tuple[str, ...]
    y0: Any
    noise: float | None
    chi_squared: float | None
    degrees_of_freedom: int | None
    ts: Any
    prediction: Any
    residuals: Any
    history: Any
    failed: Any
    unidentifiable: tuple[str, ...]
    at_bounds: tuple[str, ...]
    starts: tuple[Start, ...]
    success: bool
    message: str

    @property
    def reduced_chi_squared(self) -> float | None:
        if self.chi_squared is None or self.degrees_of_freedom is None:
            return None
        return self.chi_squared / self.degrees_of_freedom

    @property
    def probability(self) -> float | None:
        known = self.chi_squared is not None
        return float(chdtrc(self.degrees_of_freedom, self.chi_squared)) if known else None

    @property
    def fits(self) -> bool | None:
        probability = self.probability
        return None if probability is None else probability >= _LEAST_PROBABILITY

    def __str__(self) -> str:
        lines = self._verdict() + self._numbers()
        if np.any(self.failed):
            records = ", ".join(map(str, np.flatnonzero(self.failed)))
            lines.append(f"no influence, because their solve fails: records {records}")
        lines += [f"not determined by the data: {line}" for line in self.unidentifiable]
        return "\n".join(lines + (self._table() if len(self.starts) > 1 else []))

    def _verdict(self) -> list[str]:
        """Return the verdict of the optimizer, and on the model if `sigma` is known."""
        state = "fitted" if self.success else "NOT FITTED"
        ended = f"{self.message} ({len(self.history)} steps)"
        if self.fits is not False:
            return [f"{state}: {ended}"]
        state = "DOES NOT FIT" if self.success else state
        narrow = ", a bound too narrow" if self.at_bounds else ""
        return [
            f"{state}: residuals are {self.noise:.3g} times `sigma`; {ended}",
            "  Perhaps a local optimum: try other `starts` (`starts=8`), for long records `segments`.",
            f"  Otherwise the model is wrong{narrow} or `sigma` too small. Standard errors do not hold.",
        ]

    def _numbers(self) -> list[str]:
        errors, lines = self.standard_errors, []
        sizes = [None] * len(self.names) if errors is None else _flat(errors)
        for name, value, size in zip(self.names, _flat(self.parameters), sizes, strict=True):
            spread = "" if size is None else f" +- {size:.2g}"
            spread = " at its bound" if name in self.at_bounds else spread
            lines.append(f"  {name:24s} {value:.8g}{spread}")
        if self.chi_squared is not None:
            lines.append(
                f"reduced chi squared {self.reduced_chi_squared:.3g}, probability "
                f"{self.probability:.2g} ({self.degrees_of_freedom} degrees of freedom)"
            )
        elif self.noise is not None:
            lines.append(f"noise estimated from the residuals: {self.noise:.3g}")
        return lines

    def _table(self) -> list[str]:
        names = self.names[:_MOST_NAMES]
        widths = [max(len(name), 12) for name in names]
        join = lambda cells: " ".join(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))
        lines = ["starts, the best first:", f"  {'loss':>12} {'steps':>5} {join(names)}  outcome"]
        for row in self.starts:
            values = join([f"{value:.6g}" for value in _flat(row.parameters)[: len(names)]])
            lines.append(f"  {row.loss:12.6g} {row.steps:5d} {values}  {row.message}")
        return lines

    def plot(self, path: str | Path | None = None) -> Any:
        """Data and prediction of the first records, their residuals, and the loss by steps.

        **Arguments:**

        - `path`: where to save it, e.g. `"fit.png"`.

        **Returns:**

        The Matplotlib figure.
        """
        require("matplotlib", "cli", "`plot`")
        from matplotlib.figure import Figure  # takes a second to import, needed for pictures only

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
        """Return up to eight components over time, of the first record and then of others."""
        ts = np.atleast_2d(self.ts)
        flat = lambda tree: np.concatenate(
            [np.reshape(leaf, (*ts.shape, -1)) for leaf in jtu.tree_leaves(tree)], axis=2
        )
        prediction, residuals = flat(self.prediction), flat(self.residuals)
        places = itertools.islice(np.ndindex(len(ts), prediction.shape[2]), 8)
        return [(ts[r], prediction[r, :, k], residuals[r, :, k]) for r, k in places]


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(tree)])
