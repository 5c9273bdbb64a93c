"""A lithium-ion cell discharged to its cut-off voltage, beside PyBaMM and SciPy: voltages, derivatives, a fit, a batch.

`python -m benchmarks.peers.lithium_ion --json FILE --plot FILE`

The Doyle-Fuller-Newman model in finite volumes, 960 unknowns of which 100 are algebraic. PyBaMM has the same volumes, its
equations are independent of those here. SciPy integrates the differential unknowns, and the algebraic ones are solved
for in each evaluation.
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import environment, make_console, use_double_precision, write_json
from . import _lithium_ion_pybamm as pybamm, _lithium_ion_scipy as scipy
from ._lithium_ion_model import CUT_OFF
from ._lithium_ion_task import CELL, LAST, outputs, timed, TS, with_diffusivities


TOLERANCES = (1e-4, 1e-6, 1e-8)
NOISE, DRAWS = 2e-3, 20  # V
BATCH = 1000


@dataclasses.dataclass(frozen=True)
class Row:
    """`error` is the largest of the voltages (V), `end_error` that of the time of the cut-off (s), both against this library at
    1e-12; `violation` the largest residual of the algebraic equations."""

    method: str
    tolerance: float
    steps: int | None
    seconds: float
    compile_s: float | None
    error: float
    end_error: float
    violation: float | None


def compare(console: Any) -> list[Row]:
    begin = time.perf_counter()
    run = jax.jit(outputs).lower(jnp.zeros(2), 1e-6).compile()
    compile_s = time.perf_counter() - begin
    best, best_end, *_ = run(jnp.zeros(2), 1e-12)
    errors = lambda V, end: (float(np.abs(V - best).max()), float(abs(end - best_end)))
    rows: list[Row] = []
    for tolerance in TOLERANCES:
        (V, end, steps, violation), seconds = timed(run, jnp.zeros(2), tolerance)
        rows.append(
            Row(
                "Rodas5P",
                tolerance,
                int(steps),
                seconds,
                compile_s,
                *errors(V, end),
                float(violation),
            )
        )
    for tolerance in TOLERANCES[1:]:
        V, end, steps, seconds = scipy.solve(tolerance)
        rows.append(Row("SciPy, BDF", tolerance, steps, seconds, None, *errors(V, end), None))
    try:
        for tolerance in (*TOLERANCES[1:], 1e-10):
            V, end, seconds, _ = pybamm.solve(tolerance, TS, LAST)
            rows.append(
                Row("PyBaMM, IDAKLU", tolerance, None, seconds, None, *errors(V, end), None)
            )
    except ImportError:
        console.print('PyBaMM is left out: `pip install "manifold_jax\\[peers]"`.')
    return rows


def derivatives(console: Any) -> dict[str, Any]:
    """Return the gradient of the time of the cut-off beside differences, and seconds of programs."""
    run = jax.jit(outputs)
    end = lambda logarithms, tolerance: outputs(logarithms, tolerance)[1]
    gradient = jax.jit(jax.grad(end))
    tight, h = 1e-11, 1e-2
    shifted = lambda k, by: float(run(by * jnp.eye(2)[k], tight)[1])
    differences = [
        (8 * (shifted(k, h) - shifted(k, -h)) - shifted(k, 2 * h) + shifted(k, -2 * h)) / (12 * h)
        for k in range(2)
    ]
    voltages = jax.jit(jax.jacfwd(lambda logarithms: outputs(logarithms, 1e-6)[0]))
    slopes, slopes_s = timed(voltages, jnp.zeros(2))
    result = {
        "end": np.asarray(gradient(jnp.zeros(2), tight)).tolist(),
        "differences": differences,
        "gradient_s": timed(gradient, jnp.zeros(2), 1e-6)[1],
        "solve_s": timed(run, jnp.zeros(2), 1e-6)[1],
        "voltages_s": slopes_s,
    }
    try:
        _, _, seconds, theirs = pybamm.solve(1e-6, TS, LAST, derivatives=True)
        difference = float(np.abs(np.asarray(slopes) - theirs).max())
        result |= {"pybamm_voltages_s": seconds, "from_pybamm": difference}
    except ImportError:
        console.print("PyBaMM is left out.")
    return result


def fits() -> dict[str, Any]:
    """Fit both diffusivities to voltages with noise; how many of the errors are within 1.96 standard errors."""
    truth, _, *_ = jax.jit(outputs)(jnp.zeros(2), 1e-8)
    random = np.random.default_rng(0)
    begin = time.perf_counter()
    found = []
    for _ in range(DRAWS):  # the functions are the same, so that all of them share a program
        data = np.asarray(truth) + NOISE * random.normal(size=TS.size)
        result = mj.fit(
            _fitted,
            jnp.array([0.3, -0.3]),
            TS,
            data,
            y0=_rested,
            observe=_measured,
            sigma=NOISE,
            solver=mj.Rodas5P(),
            stepsize_controller=dfx.PIDController(rtol=1e-6, atol=1e-6),
        )
        found.append((np.asarray(result.parameters), np.asarray(result.standard_errors)))
    values, errors = (np.stack(column) for column in zip(*found, strict=True))
    return {
        "within": int(np.sum(np.abs(values) <= 1.96 * errors)),
        "of": values.size,
        "spread": values.std(axis=0, ddof=1).tolist(),
        "standard_errors": errors.mean(axis=0).tolist(),
        "seconds": time.perf_counter() - begin,
    }


def _fitted(logarithms: Any) -> mj.MassMatrixTerm:
    field = lambda t, state, logarithms: CELL.rates(t, state, with_diffusivities(logarithms))
    return mj.MassMatrixTerm(field, CELL.mass)


def _measured(t: Any, state: Any, logarithms: Any) -> Any:
    return CELL.voltage(state)


def _rested(logarithms: Any) -> Any:
    return CELL.start(with_diffusivities(logarithms))


def batch() -> dict[str, Any]:
    """Solve for many pairs of diffusivities at once; some are compared with a solve of their own."""
    logarithms = jnp.asarray(np.random.default_rng(1).normal(0, 0.2, (BATCH, 2)))
    run = lambda logarithms: outputs(logarithms, 1e-6)[1:3]
    together = jax.jit(jax.vmap(run)).lower(logarithms).compile()
    begin = time.perf_counter()
    ends, steps = jax.block_until_ready(together(logarithms))
    seconds = time.perf_counter() - begin
    single = jax.jit(run)
    difference = max(float(abs(single(logarithms[k])[0] - ends[k])) for k in range(5))
    alone = timed(single, logarithms[0])[1]
    return {
        "number": BATCH,
        "seconds": seconds,
        "alone_s": alone,
        "steps": int(np.max(steps)),
        "difference": difference,
        "ended": int(np.sum((ends > 0) & (ends < LAST))),
        "ends": [float(ends.min()), float(ends.max())],
    }


def show(console: Any, rows: list[Row]) -> None:
    table = Table(
        "method", "tolerance", "steps", "s", "to compile, s", "error, V", "end, s", "violation"
    )
    text = lambda value, form: "" if value is None else format(value, form)
    for row in rows:
        table.add_row(
            row.method,
            f"{row.tolerance:.0e}",
            text(row.steps, "d"),
            f"{row.seconds:.3f}",
            text(row.compile_s, ".1f"),
            f"{row.error:.1e}",
            f"{row.end_error:.1e}",
            text(row.violation, ".0e"),
        )
    console.print(table)


def draw(rows: list[Row], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    run = jax.jit(lambda logarithms: outputs(logarithms, 1e-6)[:2])
    for shift, name in ((0.0, "as measured"), (-0.5, "0.6 of it"), (0.5, "1.6 times")):
        V, end = run(jnp.array([0.0, shift]))
        inside = end > TS
        left.plot(
            [*TS[inside], end],
            [*V[inside], CUT_OFF],
            label=f"diffusivity in the positive particles: {name}",
        )
    left.axhline(CUT_OFF, color="0.6", linestyle=":", label="cut-off")
    left.set(xlabel="time, s", ylabel="voltage, V")
    left.legend(fontsize=8)
    for name in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == name]
        right.loglog([row.seconds for row in own], [row.error for row in own], "o-", label=name)
    right.set(xlabel="time of a solve, s", ylabel="largest error of the voltage, V")
    right.legend()
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw them here.")] = None,
) -> None:
    """Discharge the cell by all programs; differentiate, fit and solve in a batch by this library."""
    use_double_precision()
    console = make_console()
    rows = compare(console)
    show(console, rows)
    rest: dict[str, Any] = {}
    for name, part in (
        ("derivatives", lambda: derivatives(console)),
        ("fits", fits),
        ("batch", batch),
    ):
        rest[name] = part()
        console.print(name, rest[name])
    if json is not None:
        content = {"rows": [dataclasses.asdict(row) for row in rows], **rest}
        write_json(json, {"environment": environment("pybamm"), **content})
    if plot is not None:
        draw(rows, plot)


if __name__ == "__main__":
    typer.run(main)
