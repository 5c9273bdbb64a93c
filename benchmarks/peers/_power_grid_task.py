"""The short circuit as a reduced DAE with jumps, and the longest after which the machines stay in step."""

import time
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import manifold_jax as mj

from ._power_grid_model import Grid, MACHINE_UNKNOWNS, Machines, Parameters


BUS, START, CLEARING = 2, 0.1, 0.15
ANDES_OFFSET = 1e-8  # ANDES adds it to all impedances
OUT_OF_STEP = np.pi  # rad between two machines


class Task:
    """The grid as a reduced DAE, solved with jumps at the times of its short circuit."""

    def __init__(self, form: Any, offset: float = ANDES_OFFSET):
        self.machines = Machines()
        self.grid = Grid.of(self.machines, BUS, offset)
        self.parameters = Parameters(self.machines, np.array([START, START + CLEARING]))
        self.dae = mj.reduce_dae(self.grid.residual, self.grid.start, self.parameters, form=form)
        self.start, _ = self.dae.consistent_state(0.0, self.grid.start, self.parameters)
        toggle = self.dae.jump(
            lambda t, x, args: {**x, "fault": 1 - x["fault"]}, fixed=(*MACHINE_UNKNOWNS, "fault")
        )
        self.switch = mj.ResetAt(lambda args: args.times, toggle)

    def solve(self, solver: Any, parameters: Parameters, ts: Any, tolerance: Any) -> dfx.Solution:
        return mj.diffeqsolve(
            self.dae.terms,
            solver,
            0.0,
            ts[-1],
            None,
            self.start,
            parameters,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
            resets=(self.switch,),
            max_steps=20_000,
        )

    def angles(
        self, solver: Any, parameters: Parameters, ts: Any, tolerance: Any
    ) -> tuple[Any, ...]:
        """Return angles at the times `ts`, the largest residual of the network and the number of steps."""
        sol = self.solve(solver, parameters, ts, tolerance)
        x, rate = self.dae.outputs(sol.ts, sol.ys, parameters)
        residual = jax.vmap(lambda t, x, rate: self.grid.residual(t, x, rate, parameters)[6:8])
        violation = jnp.max(jnp.abs(jnp.stack(residual(sol.ts, x, rate))))
        return x["delta"], violation, sol.stats["num_steps"]


class Critical:
    """The clearing time after which, `later` seconds after it, two machines are half a turn apart.

    Beyond the critical time machines go apart, below they swing back. The angle at that time grows with
    `exp(later / tau)` of the difference to the critical time, which this approaches therefore as fast.
    """

    def __init__(self, task: Task, later: float, tolerance: float = 1e-11):
        self.task, self.later = task, later
        solver = mj.Projected(dfx.Dopri8(), task.dae.constraint)

        def excess(clearing: Any, inertia: Any) -> Any:
            times = jnp.stack([START, START + clearing])
            parameters = Parameters(task.machines._replace(M=inertia), times)
            ts = jnp.stack([START + clearing + later])
            sol = task.solve(solver, parameters, ts, tolerance)
            delta = task.dae.outputs(ts[0], sol.ys[0], parameters)[0]["delta"]
            return jnp.max(delta) - jnp.min(delta) - OUT_OF_STEP

        self.excess = jax.jit(excess)
        self.slopes = jax.jit(jax.grad(excess, argnums=(0, 1)))

    def clearing(self, inertia: Any) -> float:
        return brentq(lambda c: float(self.excess(c, inertia)), 0.1, 0.3, xtol=1e-13, rtol=1e-14)

    def gradient(self, clearing: float, inertia: Any) -> np.ndarray:
        """Return the derivatives by the inertias, by the implicit function theorem."""
        by_clearing, by_inertia = self.slopes(clearing, inertia)
        return -np.asarray(by_inertia) / float(by_clearing)


def critical_times(task: Task) -> dict[str, Any]:
    """Return the critical clearing time, how far it depends on what is called `later`, and its derivatives."""
    inertia = task.machines.M
    early, late = Critical(task, 1.5), Critical(task, 2.0)
    begin = time.perf_counter()
    clearing = late.clearing(inertia)
    gradient = late.gradient(clearing, inertia)
    first_s = time.perf_counter() - begin
    begin = time.perf_counter()
    late.gradient(late.clearing(inertia), inertia)
    again_s = time.perf_counter() - begin
    h = 1e-3
    shifted = lambda k, by: late.clearing(inertia + by * np.eye(inertia.size)[k])
    differences = [(shifted(k, h) - shifted(k, -h)) / (2 * h) for k in range(inertia.size)]
    return {
        "clearing": clearing,
        "half_a_second_earlier": early.clearing(inertia),
        "gradient": gradient.tolist(),
        "differences": differences,
        "first_s": first_s,
        "again_s": again_s,
    }
