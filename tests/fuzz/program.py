"""A structure as a JAX function of one lane: what a user of the library would write."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import manifold_jax as mj

from .problem import pack_state, Problem, unpack
from .structure import Structure


# Where values are asked for, as fractions of a run, and where fields may jump.
FRACTIONS = np.array([0.0, 0.11, 0.37, 0.5, 0.73, 1.0])
JUMP = 0.37
MAX_STEPS = 4096
CODES = (
    "successful",
    "event_occurred",
    "max_steps_reached",
    "dt_min_reached",
    "nonlinear_divergence",
    "nonlinear_max_steps_reached",
)


def solve(structure: Structure, adjoint: Any = None, throw: bool = False) -> Callable[[Any], Any]:
    """A function of a lane: `start`, `end`, `y0`, `args`.

    It returns all `times` (k,) and `states` (k, n) that were returned, the result `code` as an
    index into `CODES`, and the numbers of steps.
    """

    def run(lane: Any) -> Any:
        problem = Problem(structure, lane)
        function, terms, solver = problem.approach()
        controller, dt0 = _controller(structure, lane)
        saveat, event, saved_value = _output(structure, lane)
        sol = function(
            terms,
            solver,
            lane["start"],
            lane["end"],
            dt0,
            pack_state(structure, lane["y0"]),
            lane["args"],
            saveat=saveat,
            stepsize_controller=controller,
            event=event,
            max_steps=MAX_STEPS if structure.is_adaptive else structure.steps + 2,
            adjoint=mj.StepReplayAdjoint() if adjoint is None else adjoint,
            throw=throw,
        )
        times, states = saved_value(sol)
        code = sum(
            (i + 1) * (sol.result == getattr(dfx.RESULTS, name)) for i, name in enumerate(CODES)
        )
        stats = {name: sol.stats[name] for name in ("num_steps", "num_accepted_steps")}
        return {"times": times, "states": states, "code": code - 1, **stats}

    return run


def _controller(structure: Structure, lane: Any) -> tuple[Any, Any]:
    span = lane["end"] - lane["start"]
    if structure.controller == "constant":
        return dfx.ConstantStepSize(), span / structure.steps
    if structure.controller == "step-to":
        grid = np.linspace(0.0, 1.0, structure.steps + 1)
        uneven = grid + 0.3 / structure.steps * np.sin(20 * grid) * grid * (1 - grid)
        inner = lane["start"] + span * jnp.asarray(uneven[1:-1])
        return dfx.StepTo(jnp.concatenate([lane["start"][None], inner, lane["end"][None]])), None
    options: dict[str, Any] = {"rtol": structure.tolerance, "atol": structure.tolerance}
    if structure.controller == "pi":
        options |= {"pcoeff": 0.3, "icoeff": 0.4}
    if structure.controller == "limited":
        options |= {"dtmax": jnp.abs(span) / 20, "factormax": 3.0}
    controller: Any = dfx.PIDController(**options)
    if structure.controller == "clipped":
        times = lane["start"] + span * jnp.asarray([0.3, 0.5])
        controller = dfx.ClipStepSizeController(controller, step_ts=times)
    if structure.jumps:
        storing = 10 if structure.controller == "jumps-storing" else None
        times = lane["args"]["jump_time"][None]
        controller = dfx.ClipStepSizeController(
            controller, jump_ts=times, store_rejected_steps=storing
        )
    return controller, span / 50 if structure.first_step else None


def _output(structure: Structure, lane: Any) -> tuple[dfx.SaveAt, Any, Callable]:
    """What to save, the event, and how to get times and states from the solution."""
    times = lane["start"] + (lane["end"] - lane["start"]) * jnp.asarray(FRACTIONS)
    rows = jax.vmap(unpack)
    plain = lambda sol: (sol.ts, rows(sol.ys))
    with_time = lambda t, y, args: (t, y)
    inside = times[1:-1]
    if structure.output == "event":
        level = lambda t, y, args, **kwargs: level_function(jnp, unpack(y)) - args["level"]
        # A bisection raises for all lanes if one of them has no event, in plain Diffrax, too.
        event = dfx.Event(level, optx.Newton(rtol=1e-10, atol=1e-10))
        return dfx.SaveAt(t1=True), event, plain
    if structure.output == "dense":
        evaluated = lambda sol: (times, rows(jax.vmap(sol.evaluate)(times)))
        return dfx.SaveAt(dense=True), None, evaluated
    if structure.output == "fn":
        saved = lambda sol: (sol.ys[0], rows(sol.ys[1]))
        return dfx.SaveAt(ts=times, fn=with_time), None, saved
    if structure.output == "subs":
        early = dfx.SubSaveAt(t0=True, ts=inside[:2])
        late = dfx.SubSaveAt(ts=inside[2:], t1=True, fn=with_time)

        def both(sol):
            early, late = sol.ys["early"], sol.ys["late"]
            together = jnp.concatenate([sol.ts["early"], late[0]])
            return together, jnp.concatenate([rows(early), rows(late[1])])

        return dfx.SaveAt(subs={"early": early, "late": late}), None, both
    options = {
        "t1": dfx.SaveAt(t1=True),
        "ts": dfx.SaveAt(ts=times),
        "ends": dfx.SaveAt(t0=True, ts=inside, t1=True),
        "steps": dfx.SaveAt(t0=True, steps=True),
    }
    return options[structure.output], None, plain


def level_function(xp: Any, y: Any) -> Any:
    """What an event function compares with its level."""
    return xp.sum(y * np.cos(1 + np.arange(y.shape[-1])), axis=-1)
