"""Other libraries on the problems of `sparse_stiff`, all of which know where their Jacobians are not zero.

SciPy's BDF and Radau, for equations without algebraic unknowns, difference it; so does IDA (scikit-sundae),
which gets it as a function of NumPy too; IDAS (CasADi) has derivatives of its own, interpreted and as C.
"""

import importlib
import importlib.util
import os
import shutil
import time
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from rich.console import Console
from scipy.integrate import solve_ivp

from ._sparse_problems import Problem


T1 = 2.0
MAX_STEPS = 100_000


class Prepared(NamedTuple):
    """`run` returns the state at the end, perhaps of its first column only, and the number of steps."""

    run: Callable[[], tuple[Any, int]]
    compile_s: float | None = None


def processor_time() -> float:
    """Of this process, and of compilers that it has called."""
    return time.process_time() + sum(os.times()[2:4])


def peers(problem: Problem, tolerance: float) -> dict[str, Prepared]:
    """Those that are installed."""
    found = {
        f"SciPy {method}": with_scipy(problem, method, tolerance) for method in ("BDF", "Radau")
    }
    if _installed("sksundae"):
        found["scikit-sundae IDA"] = with_sundae(problem, tolerance, exact=True)
        found["scikit-sundae IDA, differences"] = with_sundae(problem, tolerance, exact=False)
    if _installed("casadi"):
        found["CasADi IDAS"] = with_casadi(problem, tolerance, {})
        if shutil.which("gcc"):
            compiled = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O1"]}}
            found["CasADi IDAS, C"] = with_casadi(problem, tolerance, compiled)
    return found


def report_missing(console: Console) -> None:
    for module in ("sksundae", "casadi"):
        if not _installed(module):
            console.print(f"{module}: skipped. It is missing: `pip install '.\\[peers]'`")


def _installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def with_scipy(problem: Problem, method: str, tolerance: float) -> Prepared:
    if problem.explicit is None:
        y0 = problem.y0
        field = lambda t, y, a: problem.rates(t, y.reshape(y0.shape), a, np).ravel()
        rows, columns, _ = _entries(problem, y0)
    else:
        y0, field = problem.y0[:, :1], problem.explicit
        cells = np.arange(len(y0))
        rows = np.concatenate([cells, cells[1:], cells[:-1]])
        columns = np.concatenate([cells, cells[:-1], cells[1:]])
    pattern = sp.csc_array((np.ones(len(rows)), (rows, columns)))
    options = {"rtol": tolerance, "atol": tolerance, "jac_sparsity": pattern}

    def run() -> tuple[np.ndarray, int]:
        args = (problem.parameter,)
        sol = solve_ivp(field, (0, T1), y0.ravel(), method=method, args=args, **options)
        return sol.y[:, -1].reshape(y0.shape), len(sol.t) - 1

    return Prepared(run)


def _entries(problem: Problem, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, columns, values = zip(*problem.jacobian(y, problem.parameter), strict=True)
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def with_sundae(problem: Problem, tolerance: float, exact: bool) -> Prepared:
    """`mass * y' - rates = 0`. Its sparse LU is SuperLU_MT, and the functions are called in Python."""
    ida = importlib.import_module("sksundae.ida")
    shape, a = problem.y0.shape, problem.parameter
    mass = np.broadcast_to(problem.mass, shape).ravel()
    rows, columns, _ = _entries(problem, problem.y0)
    order = np.lexsort((rows, columns))  # the columns one after the other
    rows, columns = rows[order].astype(np.int32), columns[order].astype(np.int32)
    masses = np.where(rows == columns, mass[rows], 0.0)

    def residual(t: float, y: np.ndarray, derivative: np.ndarray, out: np.ndarray) -> None:
        out[:] = mass * derivative - problem.rates(t, y.reshape(shape), a, np).ravel()

    def jacobian(t: Any, y: Any, derivative: Any, res: Any, factor: float, out: Any) -> None:
        out[:] = factor * masses - _entries(problem, y.reshape(shape))[2][order]

    options = {"rtol": tolerance, "atol": tolerance, "max_num_steps": MAX_STEPS}
    if problem.differential == 1:
        options["algebraic_idx"] = np.flatnonzero(mass == 0)
    pattern = sp.csc_array((np.ones(len(rows)), (rows, columns)))
    options |= {"linsolver": "sparse", "sparsity": pattern, "jacfn": jacobian if exact else None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the pattern is not used for differences then
        solver = ida.IDA(residual, **options)

    def run() -> tuple[np.ndarray, int]:
        sol = solver.solve((0.0, T1), problem.y0.ravel(), problem.slope0.ravel())
        return sol.y[-1].reshape(shape), len(sol.t) - 1

    return Prepared(run)


def with_casadi(problem: Problem, tolerance: float, compiled: dict[str, Any]) -> Prepared:
    """Semi-explicit, in its symbols. Its sparse direct solver is a QR decomposition."""
    ca = importlib.import_module("casadi")
    numbers = SimpleNamespace(
        hstack=lambda parts: ca.vertcat(*parts),
        stack=lambda parts, axis: ca.horzcat(*parts),
        sin=ca.sin,
    )
    start = processor_time()
    cells, k = len(problem.y0), problem.differential
    t, x, z = ca.SX.sym("t"), ca.SX.sym("x", k * cells), ca.SX.sym("z", (2 - k) * cells)
    # Cell by cell: CasADi's matrices lie in memory column by column.
    y = ca.vertcat(ca.reshape(x, k, cells), ca.reshape(z, 2 - k, cells)).T
    rates = problem.rates(t, y, problem.parameter, numbers).T
    equations = {"t": t, "x": x, "ode": ca.vec(rates[:k, :])}
    first = {"x0": problem.y0[:, :k].ravel()}
    if k == 1:
        equations |= {"z": z, "alg": ca.vec(rates[k:, :])}
        first["z0"] = problem.y0[:, k:].ravel()
    options = {"reltol": tolerance, "abstol": tolerance, "max_num_steps": MAX_STEPS, **compiled}
    integrator = ca.integrator("sparse", "idas", equations, 0.0, T1, options)
    compile_s = processor_time() - start

    def run() -> tuple[np.ndarray, int]:
        out = integrator(**first)
        columns = [out[name].full().reshape(cells, -1) for name in ("xf", "zf")]
        return np.concatenate(columns, axis=1), int(integrator.stats()["nsteps"])

    return Prepared(run, compile_s)
