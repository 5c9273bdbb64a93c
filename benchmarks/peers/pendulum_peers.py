"""The planar pendulum by this library, by SciPy and by libraries for DAEs, side by side.

`python -m benchmarks.peers.pendulum_peers --json FILE --plot FILE`

Cartesian coordinates `(x, y, u, v)`, ten seconds from the horizontal, 1001 output points,
rtol = atol = 1e-6, 1e-8, 1e-10. Optional libraries: `pip install manifold_jax[peers]`.
"""

import dataclasses
import functools
import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import matplotlib
import numpy as np
import scipy.integrate
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Table

import manifold_jax as mj

from ..tools.measure import (
    compiled,
    environment,
    interleaved,
    largest_difference,
    make_console,
    milliseconds,
    number,
    pendulum_violations,
    Timing,
    use_double_precision,
    write_json,
)


GRAVITY = 9.81
START = (1.0, 0.0, 0.0, 0.0)
T1 = 10.0
GRID = np.linspace(0.0, T1, 1001)
TOLERANCES = (1e-6, 1e-8, 1e-10)
MAX_STEPS = 100_000
# A violation of exactly zero is drawn here.
FLOOR = 1e-17
# The optional libraries: name of the module, name of the package.
PEERS = {"casadi": "casadi", "pydiffsol": "pydiffsol", "sksundae": "scikit-sundae"}


class Prepared(NamedTuple):
    """A method, ready to run at one tolerance.

    - `run`: solves, and returns whatever the library returns. This is what is timed.
    - `states`: that result to the states on the grid, `(1001, 4)`.
    - `steps`: an untimed solve: the number of accepted steps, and the states at their ends
        if the library gives access to them.
    - `setup_s`: compiling or building, done once for all runs.
    """

    run: Callable[[], Any]
    states: Callable[[Any], np.ndarray]
    steps: Callable[[], tuple[int | None, np.ndarray | None]]
    setup_s: float | None = None


@dataclasses.dataclass(frozen=True)
class Row:
    """What is measured of a method at one tolerance; `None` where a number is not known.

    Largest `|x^2 + y^2 - 1|` and `|x u + y v|` on the grid, the larger of both at the ends
    of the steps, and the largest error of a state component on the grid.
    """

    method: str
    tolerance: float
    steps: int | None = None
    position_violation: float | None = None
    velocity_violation: float | None = None
    violation_at_steps: float | None = None
    error: float | None = None
    median_ms: float | None = None
    low_ms: float | None = None
    high_ms: float | None = None
    setup_s: float | None = None
    failure: str | None = None


# ---- Diffrax and this library


def with_jax(tolerance: float, *, solver: dfx.AbstractSolver, projected: bool) -> Prepared:
    problem = mj.problems.pendulum(gravity=GRAVITY, t1=T1)
    front = mj.diffeqsolve if projected else dfx.diffeqsolve
    method = mj.Projected(solver, problem.constraint) if projected else solver

    def solve(saveat: dfx.SaveAt, y0: Any, args: Any) -> Any:
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        sol = front(
            problem.terms,
            method,
            0.0,
            T1,
            None,
            y0,
            args,
            saveat=saveat,
            stepsize_controller=controller,
        )
        return sol.ts, jnp.concatenate(sol.ys, axis=-1)

    def program(saveat: dfx.SaveAt) -> Any:
        return compiled(functools.partial(solve, saveat), problem.y0, problem.args)

    def steps() -> tuple[int, np.ndarray]:
        ts, ys = program(dfx.SaveAt(steps=True))[0]()
        used = np.isfinite(np.asarray(ts))
        return int(np.sum(used)), np.asarray(ys)[used]

    run, seconds = program(dfx.SaveAt(ts=jnp.asarray(GRID)))
    return Prepared(run, lambda result: np.asarray(result[1]), steps, seconds.wall_s)


# ---- SciPy


def field(t: float, state: Any) -> tuple[float, float, float, float]:
    """With floats of Python: faster than NumPy, and than calling a compiled function."""
    del t
    x, y, u, v = state.tolist()
    mu = (u * u + v * v - GRAVITY * y) / (x * x + y * y)
    return u, v, -mu * x, -GRAVITY - mu * y


def with_scipy(tolerance: float, *, method: str) -> Prepared:
    def solve(grid: np.ndarray | None) -> Any:
        return scipy.integrate.solve_ivp(
            field, (0.0, T1), START, method, grid, rtol=tolerance, atol=tolerance
        )

    def steps() -> tuple[int, np.ndarray]:
        ends = solve(None).y.T[1:]
        return len(ends), ends

    return Prepared(functools.partial(solve, GRID), lambda sol: sol.y.T, steps)


def on_circle(state: np.ndarray) -> np.ndarray:
    """One state, scaled to the circle and without the velocity across it."""
    x, y, u, v = state.tolist()
    r = (x * x + y * y) ** 0.5
    x, y = x / r, y / r
    across = x * u + y * v
    return np.array((x, y, u - across * x, v - across * y))


def all_on_circle(states: np.ndarray) -> np.ndarray:
    """The same of many states `(4, times)` at once."""
    q = states[:2] / np.sqrt(np.sum(states[:2] ** 2, axis=0))
    return np.concatenate([q, states[2:] - np.sum(q * states[2:], axis=0) * q])


def with_projected_scipy(tolerance: float) -> Prepared:
    """What one writes by hand around SciPy's stepper: project after each step, then go on
    from there, and project what is interpolated."""

    def solve() -> tuple[np.ndarray, list[np.ndarray]]:
        stepper = scipy.integrate.DOP853(field, 0.0, START, T1, rtol=tolerance, atol=tolerance)
        output, ends = [np.array(START)[:, None]], []
        done = 1
        while stepper.status == "running":
            stepper.step()
            if stepper.status == "failed":
                raise RuntimeError("the step size became too small")
            stepper.y = on_circle(stepper.y)
            # otherwise the next step would start with the derivative of the uncorrected state
            stepper.f = np.array(field(stepper.t, stepper.y))
            ends.append(stepper.y)
            reached = np.searchsorted(GRID, stepper.t, side="right")
            if reached > done:
                output.append(stepper.dense_output()(GRID[done:reached]))
                done = reached
        return all_on_circle(np.concatenate(output, axis=1)).T, ends

    def steps() -> tuple[int, np.ndarray]:
        ends = np.stack(solve()[1])
        return len(ends), ends

    return Prepared(solve, lambda result: result[0], steps)


# ---- CasADi


def with_casadi(tolerance: float, *, plugin: str) -> Prepared:
    """`idas`: index 1, with the multiplier as algebraic variable. `cvodes`: the ODE in which
    it has been eliminated, by the Adams formulas (faster than BDF here)."""
    ca = importlib.import_module("casadi")
    x, y, u, v, z = (ca.SX.sym(name) for name in "xyuvz")
    rest = u * u + v * v - GRAVITY * y
    mu = z if plugin == "idas" else rest / (x * x + y * y)
    equations = {"x": ca.vertcat(x, y, u, v), "ode": ca.vertcat(u, v, -mu * x, -GRAVITY - mu * y)}
    options = {"reltol": tolerance, "abstol": tolerance, "max_num_steps": MAX_STEPS}
    if plugin == "idas":
        equations |= {"z": z, "alg": rest - z * (x * x + y * y)}
    else:
        options |= {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"}
    start = time.perf_counter()
    integrator = ca.integrator("pendulum", plugin, equations, 0.0, GRID, options)
    setup_s = time.perf_counter() - start

    def run() -> np.ndarray:
        return integrator(x0=START)["xf"].full()

    def steps() -> tuple[int, None]:
        run()
        return int(integrator.stats()["nsteps"]), None

    return Prepared(run, lambda states: states.T, steps, setup_s)


# ---- pydiffsol

# The state has to be called `u` there.
DIFFSL_ODE = """
g {{ {g} }}
u_i {{ x = 1, y = 0, vx = 0, vy = 0 }}
mu {{ (vx*vx + vy*vy - g*y) / (x*x + y*y) }}
F_i {{ vx, vy, -mu*x, -g - mu*y }}
"""
DIFFSL_DAE = """
g {{ {g} }}
u_i {{ x = 1, y = 0, vx = 0, vy = 0, mu = 0 }}
dudt_i {{ dx = 0, dy = 0, dvx = 0, dvy = 0, dmu = 0 }}
M_i {{ dx, dy, dvx, dvy, 0 }}
F_i {{ vx, vy, -mu*x, -g - mu*y, vx*vx + vy*vy - g*y - mu*(x*x + y*y) }}
"""


def with_pydiffsol(tolerance: float, *, code: str, solver: str) -> Prepared:
    ds = importlib.import_module("pydiffsol")
    start = time.perf_counter()
    ode = ds.Ode(
        code.format(g=GRAVITY), matrix_type=ds.nalgebra_dense, ode_solver=getattr(ds, solver)
    )
    setup_s = time.perf_counter() - start
    ode.rtol = ode.atol = tolerance
    parameters = np.array([])

    def run() -> np.ndarray:
        return ode.solve_dense(parameters, GRID).ys

    def steps() -> tuple[int, np.ndarray]:
        ends = ode.solve(parameters, T1).ys[:4].T[1:]
        return len(ends), ends

    return Prepared(run, lambda states: states[:4].T, steps, setup_s)


# ---- scikit-sundae


def with_sundae(tolerance: float) -> Prepared:
    """IDA, index 1; it calls the residual in Python."""
    ida = importlib.import_module("sksundae.ida")

    def residual(t: float, state: Any, derivative: Any, out: Any) -> None:
        x, y, u, v, mu = state.tolist()
        dx, dy, du, dv, _ = derivative.tolist()
        rest = u * u + v * v - GRAVITY * y - mu * (x * x + y * y)
        out[:] = (dx - u, dy - v, du + mu * x, dv + GRAVITY + mu * y, rest)

    solver = ida.IDA(
        residual, rtol=tolerance, atol=tolerance, algebraic_idx=[4], max_num_steps=MAX_STEPS
    )

    def solve(times: Any) -> np.ndarray:
        sol = solver.solve(times, [*START, 0.0], [0.0, 0.0, 0.0, -GRAVITY, 0.0])
        if not sol.success:
            raise RuntimeError(sol.message)
        return sol.y[:, :4]

    def steps() -> tuple[int, np.ndarray]:
        ends = solve((0.0, T1))[1:]  # of two times it makes all steps in between
        return len(ends), ends

    return Prepared(functools.partial(solve, GRID), lambda states: states, steps)


# ---- the comparison


class Method(NamedTuple):
    """A method and how it is drawn; `module` is the optional library it needs."""

    name: str
    prepare: Callable[[float], Prepared]
    module: str | None
    colour: str
    marker: str


def _jax(solver: dfx.AbstractSolver, projected: bool) -> Callable[[float], Prepared]:
    return functools.partial(with_jax, solver=solver, projected=projected)


def _scipy(method: str) -> Callable[[float], Prepared]:
    return functools.partial(with_scipy, method=method)


def _pydiffsol(code: str, solver: str) -> Callable[[float], Prepared]:
    return functools.partial(with_pydiffsol, code=code, solver=solver)


def _casadi(plugin: str) -> Callable[[float], Prepared]:
    return functools.partial(with_casadi, plugin=plugin)


# A colour for each library (Okabe & Ito, safe for the colour-blind), a marker for each method.
OURS, DIFFRAX, SCIPY, CASADI, PYDIFFSOL, SUNDAE = (
    "#D55E00", "#000000", "#0072B2", "#009E73", "#CC79A7", "#E69F00",
)  # fmt: skip

METHODS = (
    Method("manifold_jax, projected Tsit5", _jax(dfx.Tsit5(), True), None, OURS, "o"),
    Method("manifold_jax, projected Dopri8", _jax(dfx.Dopri8(), True), None, OURS, "s"),
    Method("Diffrax, plain Tsit5", _jax(dfx.Tsit5(), False), None, DIFFRAX, "o"),
    Method("SciPy RK45", _scipy("RK45"), None, SCIPY, "o"),
    Method("SciPy DOP853", _scipy("DOP853"), None, SCIPY, "s"),
    Method("SciPy LSODA", _scipy("LSODA"), None, SCIPY, "^"),
    Method("SciPy DOP853, projected by hand", with_projected_scipy, None, SCIPY, "D"),
    Method("CasADi IDAS, index 1", _casadi("idas"), "casadi", CASADI, "v"),
    Method("CasADi CVODES, Adams", _casadi("cvodes"), "casadi", CASADI, "^"),
    Method("pydiffsol tsit45", _pydiffsol(DIFFSL_ODE, "tsit45"), "pydiffsol", PYDIFFSOL, "o"),
    Method("pydiffsol BDF, index 1", _pydiffsol(DIFFSL_DAE, "bdf"), "pydiffsol", PYDIFFSOL, "v"),
    Method("scikit-sundae IDA, index 1", with_sundae, "sksundae", SUNDAE, "v"),
)


def missing_modules() -> list[str]:
    missing = []
    for module in PEERS:
        try:
            importlib.import_module(module)
        except ImportError:
            missing.append(module)
    return missing


def compare(methods: list[Method], tolerance: float, repeats: int) -> list[Row]:
    """All methods at one tolerance. One that fails gets a row that says so."""
    reference = np.concatenate(mj.problems.pendulum(gravity=GRAVITY, t1=T1).reference(GRID), -1)
    rows, runs = {}, {}
    for method in methods:
        try:
            prepared = method.prepare(tolerance)
            rows[method.name] = _check(method.name, tolerance, prepared, reference)
            runs[method.name] = prepared.run
        except Exception as error:  # of a library: the other methods are still of interest
            reason = str(error).strip().partition("\n")[0]
            rows[method.name] = Row(method.name, tolerance, failure=reason)
    timings = interleaved(runs, repeats)
    return [_with_timing(row, timings.get(row.method)) for row in rows.values()]


def _check(name: str, tolerance: float, prepared: Prepared, reference: np.ndarray) -> Row:
    states = prepared.states(prepared.run())
    position, velocity = pendulum_violations(states)
    error = largest_difference(states, reference)
    count, ends = prepared.steps()
    return Row(
        name,
        tolerance,
        steps=count,
        position_violation=position,
        velocity_violation=velocity,
        violation_at_steps=None if ends is None else max(pendulum_violations(ends)),
        error=error,
        setup_s=prepared.setup_s,
    )


def _with_timing(row: Row, timing: Timing | None) -> Row:
    return row if timing is None else dataclasses.replace(row, **dataclasses.asdict(timing))


def result_table(rows: list[Row]) -> Table:
    table = Table(title="Pendulum, 10 s, 1001 output points", title_justify="left")
    table.add_column("tol", no_wrap=True)
    table.add_column("method", no_wrap=True)
    for heading in (
        "steps",
        "|x²+y²-1|\non grid",
        "|xu+yv|\non grid",
        "largest\nat steps",
        "error\nof state",
        "run ms\n(quartiles)",
        "setup\ns",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    previous = None
    for row in rows:
        if row.tolerance != previous:
            table.add_section()
        tolerance = f"{row.tolerance:.0e}" if row.tolerance != previous else ""
        table.add_row(tolerance, row.method, *_cells(row))
        previous = row.tolerance
    return table


def _cells(row: Row) -> list[str]:
    if row.failure is not None:
        return ["[red]failed[/red]"]
    quartiles = f"({milliseconds(row.low_ms)}-{milliseconds(row.high_ms)})"
    return [
        number(row.steps, "d"),
        number(row.position_violation, ".1e"),
        number(row.velocity_violation, ".1e"),
        number(row.violation_at_steps, ".1e"),
        number(row.error, ".1e"),
        f"{milliseconds(row.median_ms)} {quartiles}",
        number(row.setup_s, ".2f"),
    ]


def write_figure(path: Path, methods: list[Method], rows: list[Row]) -> None:
    """Error and violation over run time, a line through the tolerances of each method."""
    matplotlib.use("Agg")
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    lines = []
    for method in methods:
        solved = [row for row in rows if row.method == method.name and row.failure is None]
        if solved:
            lines.append(_draw(left, method, solved, [row.error for row in solved]))
            _draw(right, method, solved, [_violation(row) for row in solved])
    left.set(title="error of the state", ylabel="largest error of a component, on the grid")
    right.set(
        title="violation of the constraints",
        ylabel="largest of $|x^2+y^2-1|$ and $|xu+yv|$, on the grid",
    )
    for axes in (left, right):
        axes.set(xlabel="run time (ms)", xscale="log", yscale="log")
        axes.grid(alpha=0.3)
    right.set_ylim(bottom=FLOOR)
    figure.legend(handles=lines, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    tolerances = sorted({row.tolerance for row in rows}, reverse=True)
    labels = ", ".join(f"$10^{{{round(np.log10(tolerance))}}}$" for tolerance in tolerances)
    figure.suptitle(
        f"Pendulum in Cartesian coordinates, {T1:g} s, {len(GRID)} output points, "
        f"rtol = atol = {labels} (from left to right)"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def _violation(row: Row) -> float:
    return max(row.position_violation or 0.0, row.velocity_violation or 0.0, FLOOR)


def _draw(axes: Axes, method: Method, rows: list[Row], values: list[Any]) -> Any:
    """Methods that project are filled and thick, the others hollow."""
    projects = "projected" in method.name
    (line,) = axes.plot(
        [row.median_ms for row in rows],
        values,
        color=method.colour,
        marker=method.marker,
        markerfacecolor=method.colour if projects else "white",
        linewidth=2 if projects else 1,
        linestyle="-" if projects else "--",
        label=method.name,
        zorder=3 if projects else 2,
    )
    return line


def main(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write results here.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw a picture.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Timed runs of every method.")] = 21,
    quick: Annotated[bool, typer.Option(help="One tolerance alone.")] = False,
) -> None:
    """Compare ways to solve the pendulum: error, violation and time at three tolerances."""
    use_double_precision()
    console = make_console()
    missing = missing_modules()
    for module in missing:
        console.print(f"{PEERS[module]} is not installed (extra `peers`): left out")
    methods = [method for method in METHODS if method.module not in missing]
    rows: list[Row] = []
    for tolerance in TOLERANCES[:1] if quick else TOLERANCES:
        with console.status(f"tolerance {tolerance:.0e}"):
            rows += compare(methods, tolerance, repeats)
    console.print(result_table(rows))
    for row in rows:
        if row.failure is not None:
            console.print(f"{row.method}, {row.tolerance:.0e}: {escape(row.failure)}")
    if json is not None:
        settings = {
            "gravity": GRAVITY,
            "start": START,
            "t1": T1,
            "points": len(GRID),
            "repeats": repeats,
            "left_out": [PEERS[module] for module in missing],
        }
        environ = environment(*PEERS.values())
        content = {"environment": environ, "settings": settings}
        write_json(json, {**content, "rows": [dataclasses.asdict(row) for row in rows]})
    if plot is not None:
        write_figure(plot, methods, rows)


if __name__ == "__main__":
    typer.run(main)
