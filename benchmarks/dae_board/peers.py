"""Other solvers of DAEs on the problems of the board, each skipped where it is absent: scikit-sundae
(IDA) and scipy_dae on the same residual, as it is written, from the same consistent start; CasADi,
which reduces the index itself, on the pendulum in its own symbols."""

import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from .solve import Reduction, residual_in_numbers


MAX_STEPS = 20_000
PATIENCE = 20.0  # seconds, after which a solve is given up


class PeerRow(NamedTuple):
    """`digits` is `None` for a solve that failed or took too long, as `status` says."""

    method: str
    status: str
    digits: float | None
    steps: int | None
    seconds: float


class _OutOfPatience(Exception):
    pass


PEERS = {
    "sksundae": "IDA (scikit-sundae)",
    "scipy_dae": "Radau (scipy_dae)",
    "casadi": "reduced, IDAS (CasADi)",
}


def installed() -> list[str]:
    return [name for name in PEERS if importlib.util.find_spec(name) is not None]


def run_peers(reduction: Reduction) -> list[PeerRow]:
    solvers = {"sksundae": _ida, "scipy_dae": with_scipy_dae, "casadi": _casadi}
    residual, x0, xdot0 = residual_in_numbers(reduction)
    unravel = jfu.ravel_pytree(reduction.start)[1]
    rows = []
    for name in installed():
        if name == "casadi" and reduction.problem.for_casadi is None:
            continue
        before = time.perf_counter()

        def timed(t: Any, x: Any, xdot: Any, before: float = before) -> np.ndarray:
            if time.perf_counter() - before > PATIENCE:
                raise _OutOfPatience
            return np.asarray(residual(t, x, xdot))

        digits, steps, status = None, None, "ok"
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                end, steps, success = solvers[name](reduction, timed, x0, xdot0)
            if success:
                digits = reduction.problem.digits(unravel(jnp.asarray(end)))
            else:
                status = "failed"
        except _OutOfPatience:
            status = f"over {PATIENCE:.0f} s"
        except Exception as error:  # a benchmark goes on whatever another library raises
            status = f"failed: {type(error).__name__}"
        rows.append(PeerRow(PEERS[name], status, digits, steps, time.perf_counter() - before))
    return rows


def _ida(reduction: Reduction, residual: Callable, x0: Any, xdot0: Any) -> tuple[Any, int, bool]:
    ida = importlib.import_module("sksundae.ida")

    def into(t: float, x: Any, xdot: Any, out: Any) -> None:
        out[:] = residual(t, x, xdot)

    problem = reduction.problem
    solver = ida.IDA(into, rtol=problem.rtol, atol=problem.atol, max_num_steps=MAX_STEPS)
    sol = solver.solve((0.0, problem.t1), x0, xdot0)
    return sol.y[-1], len(sol.t) - 1, bool(sol.success)


def with_scipy_dae(
    reduction: Reduction, residual: Callable, x0: Any, xdot0: Any
) -> tuple[Any, int, bool]:
    integrate = importlib.import_module("scipy_dae.integrate")
    problem = reduction.problem
    sol = integrate.solve_dae(
        residual, (0.0, problem.t1), x0, xdot0, method="Radau", rtol=problem.rtol, atol=problem.atol
    )
    return sol.y[:, -1], len(sol.t) - 1, bool(sol.success)


def _casadi(reduction: Reduction, residual: Callable, x0: Any, xdot0: Any) -> tuple[Any, int, bool]:
    """Its reduction adds the derivatives `q'` to the states `(q, v)`, all of which stay on the
    manifold only as far as the tolerance goes."""
    del residual, x0, xdot0
    ca = importlib.import_module("casadi")
    problem = reduction.problem
    written, start = problem.for_casadi(ca)
    reduced, _ = ca.dae_reduce_index(written, {})
    explicit, to_written, _ = ca.dae_map_semi_expl(written, reduced)
    options = {"reltol": problem.rtol, "abstol": problem.atol, "max_num_steps": MAX_STEPS}
    integrator = ca.integrator("pendulum", "idas", explicit, 0.0, problem.t1, options)
    out = integrator(**start)
    q_and_v, _, force = to_written(out["xf"], out["zf"])
    # In the order of the board's names: force, q, v.
    end = np.concatenate([np.ravel(force), np.ravel(q_and_v)])
    return end, int(integrator.stats()["nsteps"]), True
