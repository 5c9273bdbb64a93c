"""Optional libraries for stiff equations, each skipped with a message where it is absent."""

import importlib
import importlib.util
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from ..tools.stiff_problems import PROBLEMS, StiffProblem


MAX_STEPS = 100_000


def peers(problem: StiffProblem, console: Console) -> dict[str, Callable[[], Any]]:
    """Functions that return the state at the end, the number of steps and whether it is one."""
    diagonal = problem.mass is None or np.ndim(problem.mass) == 1
    is_robertson = problem is PROBLEMS["Robertson"]
    wanted = [
        ("casadi", "CasADi CVODES" if problem.mass is None else "CasADi IDAS", casadi, diagonal),
        ("pydiffsol", "pydiffsol BDF", pydiffsol, is_robertson),
        # The transistor amplifier takes it minutes (166762 steps, 5 digits).
        ("sksundae", "scikit-sundae IDA", sundae, diagonal),
    ]
    runs = {}
    for module, name, prepare, possible in wanted:
        if not possible:
            continue
        if importlib.util.find_spec(module) is None:
            console.print(f"{name}: skipped. It needs {module}: `pip install '.\\[peers]'`")
            continue
        runs[name] = prepare(problem)
    return runs


def casadi(problem: StiffProblem) -> Callable[[], Any]:
    """In its own symbols, with derivatives of its own."""
    ca = importlib.import_module("casadi")
    numbers = SimpleNamespace(
        stack=lambda parts: ca.vertcat(*parts), exp=ca.exp, sin=ca.sin, sqrt=ca.sqrt
    )
    n, t = len(problem.y0), ca.SX.sym("t")
    mass = np.ones(n) if problem.mass is None else problem.mass
    y = ca.SX.sym("y", n)
    f = problem.field(numbers)(t, y, problem.args)
    known, free = np.flatnonzero(mass).tolist(), np.flatnonzero(mass == 0).tolist()
    equations = {"t": t, "x": y[known], "ode": f[known]}
    if free:
        equations |= {"z": y[free], "alg": f[free]}
    options = {"reltol": problem.rtol, "abstol": problem.atol, "max_num_steps": MAX_STEPS}
    plugin = "idas" if free else "cvodes"
    integrator = ca.integrator("stiff", plugin, equations, 0.0, problem.t1, options)

    def run():
        start = {"x0": problem.y0[known]} | ({"z0": problem.y0[free]} if free else {})
        try:
            out = integrator(**start)
        except RuntimeError:
            return problem.y0, None, False
        end = np.empty(n)
        end[known] = out["xf"].full().ravel()
        end[free] = out["zf"].full().ravel()
        return end, int(integrator.stats()["nsteps"]), True

    return run


ROBERTSON = """
a {{ {0} }} b {{ {1} }} c {{ {2} }}
u_i {{ x = 1, y = 0, z = 0 }}
F_i {{ c*y*z - a*x, a*x - c*y*z - b*y*y, b*y*y }}
"""


def pydiffsol(problem: StiffProblem) -> Callable[[], Any]:
    """Of Robertson's reaction, in its own language."""
    ds = importlib.import_module("pydiffsol")
    code = ROBERTSON.format(*problem.args)
    ode = ds.Ode(code, matrix_type=ds.nalgebra_dense, ode_solver=ds.bdf)
    ode.rtol, ode.atol = problem.rtol, problem.atol

    def run():
        ys = ode.solve(np.array([]), problem.t1).ys
        return ys[:, -1], ys.shape[1] - 1, True

    return run


def sundae(problem: StiffProblem) -> Callable[[], Any]:
    """IDA; it calls the residual in Python and differences it."""
    ida = importlib.import_module("sksundae.ida")
    field, n = problem.field(np), len(problem.y0)
    mass = np.ones(n) if problem.mass is None else problem.mass

    def residual(t, y, derivative, out):
        out[:] = mass * derivative - field(t, y, problem.args)

    slope = mass * field(0.0, problem.y0, problem.args)  # masses are zero or one
    options = dict(rtol=problem.rtol, atol=problem.atol, max_num_steps=MAX_STEPS)
    if np.any(mass == 0):
        options["algebraic_idx"] = np.flatnonzero(mass == 0).tolist()

    def run():
        solver = ida.IDA(residual, **options)
        sol = solver.solve((0.0, problem.t1), problem.y0, slope)
        return sol.y[-1], len(sol.t) - 1, sol.success

    return run
