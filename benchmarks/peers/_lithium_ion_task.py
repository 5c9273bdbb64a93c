"""The cell discharged to its cut-off voltage, with other diffusivities in its particles."""

import time
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import manifold_jax as mj

from ._lithium_ion_model import Cell, CUT_OFF, NEGATIVE, Parameters, POSITIVE


CELL = Cell()
LAST = 3700.0
TS = np.linspace(0.0, 3540.0, 60)


def with_diffusivities(logarithms: Any) -> Parameters:
    """Return parameters with `exp(logarithms)` times the diffusivities of negative and positive particles."""
    factors = jnp.exp(jnp.asarray(logarithms))
    negative = NEGATIVE._replace(diffusivity=NEGATIVE.diffusivity * factors[0])
    return Parameters(negative, POSITIVE._replace(diffusivity=POSITIVE.diffusivity * factors[1]))


def discharge(parameters: Parameters, tolerance: Any, max_steps: int = 8192) -> dfx.Solution:
    """Solve up to the cut-off; the states at `TS` and at the end."""
    voltage = lambda t, state, args, **kwargs: CELL.voltage(state) - CUT_OFF
    return mj.diffeqsolve(
        CELL.term,
        mj.Rodas5P(),
        0.0,
        LAST,
        None,
        CELL.start(parameters),
        parameters,
        saveat=dfx.SaveAt(ts=TS, t1=True),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        event=dfx.Event(voltage, optx.Newton(rtol=1e-12, atol=1e-12)),
        max_steps=max_steps,
        consistent="project",
        throw=False,
    )


def outputs(logarithms: Any, tolerance: Any) -> tuple[Any, ...]:
    """Return voltages, the time of the cut-off, steps and the largest algebraic residual."""
    parameters = with_diffusivities(logarithms)
    sol = discharge(parameters, tolerance)
    rates = jax.vmap(lambda state: CELL.rates(0.0, state, parameters))(sol.ys)
    residual = [jnp.max(jnp.abs(rates[name][: TS.size + 1])) for name in ("solid", "electrolyte")]
    V = jax.vmap(CELL.voltage)(sol.ys)[: TS.size]
    end = jnp.max(jnp.where(jnp.isfinite(sol.ts), sol.ts, 0.0))
    return V, end, sol.stats["num_steps"], jnp.maximum(*residual)


def timed(function: Any, *args: Any) -> tuple[Any, float]:
    jax.block_until_ready(function(*args))
    begin = time.perf_counter()
    result = jax.block_until_ready(function(*args))
    return result, time.perf_counter() - begin
