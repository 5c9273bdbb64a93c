"""Random equations whose state jumps at random events, against a loop around SciPy."""

import dataclasses
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import manifold_jax as mj

from .checks import Fault


SOLVERS = {
    "Tsit5": dfx.Tsit5(),
    "Dopri8": dfx.Dopri8(),
    "Bosh3": dfx.Bosh3(),
    "Kvaerno5": dfx.Kvaerno5(),
    "Rodas5P": mj.Rodas5P(),
}
TOLERANCES = {"Bosh3": 1e-8}
MOST = 30  # resets
SPAN = 4.0
# Lanes are not judged whose events are almost at one time, graze, or almost undo each other.
CLEAR = 1e-3

Args = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Switched:
    """`y' = A y + b cos(w t) + tanh(C y)` in `size` unknowns, tangent to spheres about 0 unless `approach` is
    "plain", with jumps `y+ = B y + d` where `c y + e t` crosses a level, and at known times."""

    index: int
    seed: int
    size: int
    approach: str
    solver: str
    directions: tuple[bool | None, ...]  # of the conditions; known times come last
    doses: int
    backwards: bool
    clipped: bool

    @property
    def spec(self) -> str:
        return str(dataclasses.asdict(self))

    def field(self, xp: Any, t: Any, y: Any, args: Args) -> Any:
        f = args["A"] @ y + args["b"] * xp.cos(args["w"] * t) + xp.tanh(args["C"] @ y)
        return f if self.approach == "plain" else f - y * (y @ f) / (y @ y)

    def condition(self, k: int, t: Any, y: Any, args: Args) -> Any:
        return args["c"][k] @ y + args["e"][k] * t - args["level"][k]

    def jump(self, k: int, t: Any, y: Any, args: Args) -> Any:
        del t
        after = args["B"][k] @ y + args["d"][k]
        if self.approach == "plain":
            return after
        return 1.01 * after * args["radius"] / (after @ after) ** 0.5  # corrected to 1

    def on_manifold(self, y: np.ndarray, args: Args) -> np.ndarray:
        return y if self.approach == "plain" else y * args["radius"] / np.sqrt(y @ y)


def switched(index: int, seed: int) -> Switched:
    rng = np.random.default_rng((seed, index, 20))
    choose = lambda options: options[int(rng.integers(len(options)))]
    approach = choose(("plain", "projected", "projected", "local"))
    solver = choose(("Tsit5", "Tsit5", "Dopri8", "Bosh3", "Kvaerno5"))
    if approach == "plain" and rng.random() < 0.2:
        solver = "Rodas5P"
    return Switched(
        index=index,
        seed=seed,
        size=int(rng.integers(2, 5)),
        approach=approach,
        solver="Tsit5" if approach == "local" else solver,
        directions=tuple(choose((True, False, None)) for _ in range(int(rng.integers(1, 4)))),
        doses=int(rng.integers(0, 3)),
        backwards=bool(rng.random() < 0.3),
        clipped=bool(rng.random() < 0.15),
    )


def draw(one: Switched, draws: int) -> tuple[Args, np.ndarray]:
    """Parameters and starts with a leading axis of lanes."""
    rng = np.random.default_rng((one.seed, one.index, 21))
    n, count = one.size, len(one.directions)
    jumps = count + (one.doses > 0)
    normal = lambda *shape: rng.normal(size=(draws, *shape))
    y0 = normal(n)
    args = {
        "A": normal(n, n) / np.sqrt(n),
        "b": normal(n),
        "w": rng.uniform(1.0, 4.0, draws),
        "C": normal(n, n),
        "c": normal(count, n),
        "e": 0.2 * normal(count),
        "level": 0.3 * normal(count),
        "B": 0.5 * normal(jumps, n, n),
        "d": 0.5 * normal(jumps, n),
        "doses": rng.uniform(0.1, 0.9, (draws, one.doses)) * SPAN * (-1 if one.backwards else 1),
        "radius": np.sqrt(np.sum(y0**2, axis=1)),
    }
    return args, y0


def solution(one: Switched, args: Args, y0: Any, **options: Any) -> Any:
    """Solve one lane with this library."""
    conditions = range(len(one.directions))
    resets = [
        mj.Reset(
            lambda t, y, args, k=k: one.condition(k, t, y, args),
            lambda t, y, args, k=k: one.jump(k, t, y, args),
            direction=one.directions[k],
            samples=20,
        )
        for k in conditions
    ]
    if one.doses:
        last = len(conditions)
        dose = lambda t, y, args: one.jump(last, t, y, args)
        resets.append(mj.ResetAt(lambda args: args["doses"], dose))
    solver: Any = SOLVERS[one.solver]
    sphere = mj.Constraint(lambda t, y, args: jnp.stack([y @ y - args["radius"] ** 2]))
    if one.approach != "plain":
        wrap = mj.Projected if one.approach == "projected" else mj.LocalCoordinates
        solver = wrap(solver, sphere)
    tolerance = TOLERANCES.get(one.solver, 1e-10)
    controller: Any = dfx.PIDController(rtol=tolerance, atol=tolerance)
    if one.clipped:
        controller = dfx.ClipStepSizeController(controller, jump_ts=jnp.array([0.3, 0.77]))
    return mj.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: one.field(jnp, t, y, args)),
        solver,
        0.0,
        -SPAN if one.backwards else SPAN,
        None,
        y0,
        args,
        stepsize_controller=controller,
        resets=resets,
        max_resets=MOST,
        max_steps=20_000,
        throw=False,
        **options,
    )


@dataclasses.dataclass
class Expected:
    """What a loop around SciPy finds; `clear` unless events almost coincide or graze."""

    times: list[float]
    indices: list[int]
    y: np.ndarray
    clear: bool


def reference(one: Switched, args: Args, y0: np.ndarray) -> Expected:
    """Restart DOP853 after every jump. An event that a jump causes comes at once, the first first."""
    sign = -1.0 if one.backwards else 1.0  # the time of the loop increases
    count = len(one.directions)
    wanted = np.array([{True: 1, False: -1, None: 0}[d] for d in one.directions])
    values = lambda s, y: np.array([one.condition(k, sign * s, y, args) for k in range(count)])
    doses = sorted(abs(args["doses"]))
    field = lambda s, y: sign * one.field(np, sign * s, y, args)
    found = Expected([], [], one.on_manifold(y0, args), True)
    s, waiting, before = 0.0, [], np.zeros(count)
    while s < SPAN and len(found.times) <= MOST:
        if waiting:
            k = waiting[0]
        else:
            end = doses[0] if doses else SPAN
            s, found.y, k, clear = _until_event(one, field, values, wanted, s, end, found.y)
            found.clear &= clear
            if k is None and not doses:
                break
            if k is None:
                doses.pop(0)
                k = count
            before = np.sign(values(s, found.y))
        if k < count:
            before[k] = 0  # may have any sign after its own jump
        pending = {i: before[i] for i in waiting if i != k}
        found.times.append(sign * s)
        found.indices.append(k)
        found.y = one.on_manifold(one.jump(k, sign * s, found.y, args), args)
        after = values(s, found.y)
        found.clear &= bool(np.min(np.abs(after)) > CLEAR)
        crossed = before * np.sign(after) < 0
        crossed &= (wanted == 0) | (np.sign(after) == wanted)
        waiting = [i for i in range(count) if crossed[i]]
        before = np.where(crossed, before, np.sign(after))
        for i, side in pending.items():
            before[i] = side
    return found


def _until_event(one, field, values, wanted, s, end, y):
    """Return time and state of the first event before `end`, or there, and which it is."""
    events = []
    for k in range(len(wanted)):

        def event(s, y, k=k):
            return values(s, y)[k]

        event.terminal, event.direction = True, float(wanted[k])
        events.append(event)
    solved = scipy.integrate.solve_ivp(
        field, (s, end), y, "DOP853", rtol=1e-12, atol=1e-13, events=events, max_step=0.02
    )
    last, y = solved.t[-1], solved.y[:, -1]
    if solved.status != 1:
        return last, y, None, _is_clear(solved, values, None)
    k = int(np.argmin([abs(t[-1] - last) if t.size else np.inf for t in solved.t_events]))
    return last, one.on_manifold(y, {"radius": np.sqrt(y @ y)}), k, _is_clear(solved, values, k)


def _is_clear(solved: Any, values: Any, cause: int | None) -> bool:
    """Whether no condition but the cause comes near zero without crossing it, or at the end."""
    inside = np.array([values(s, y) for s, y in zip(solved.t, solved.y.T, strict=True)])
    if len(inside) < 3:
        return False
    size = np.abs(inside)
    turns = (size[1:-1] < size[:-2]) & (size[1:-1] < size[2:])
    turns &= np.sign(inside[1:-1]) == np.sign(inside[2:])
    turns &= np.sign(inside[1:-1]) == np.sign(inside[:-2])
    ends = np.delete(size[-1], cause) if cause is not None else size[-1]
    rate = np.inf
    if cause is not None:
        rate = abs(inside[-1] - inside[-3])[cause] / (solved.t[-1] - solved.t[-3])
    grazes = np.any(size[1:-1][turns] < CLEAR)
    return not grazes and np.min(ends, initial=np.inf) > CLEAR and rate > 20 * CLEAR


def examine(one: Switched, draws: int, faults: list[Fault]) -> dict[str, Any]:
    """Add what is wrong with what is returned; returns how large the errors were."""
    args, starts = draw(one, draws)
    take = lambda i: ({name: x[i] for name, x in args.items()}, starts[i])
    expected = [reference(one, *take(i)) for i in range(draws)]
    judged = [
        i
        for i, x in enumerate(expected)
        if x.clear and len(x.times) <= MOST - 5 and np.all(abs(x.y) < 1e3)
    ]
    found = jax.jit(jax.vmap(lambda args, y0: solution(one, args, y0)))(args, starts)
    numbers: dict[str, Any] = {"cases": draws, "trusted": len(judged), "error": 0.0}
    numbers["resets"] = int(np.sum([len(expected[i].times) for i in judged]))
    ys, number = np.asarray(found.ys[:, 0]), np.asarray(found.resets.number)
    codes = np.asarray(jax.tree.leaves(found.result)[0])
    for i in judged:
        count = len(expected[i].times)
        if codes[i] != 0:
            faults.append(Fault("refused", f"lane {i}: result {codes[i]} after {number[i]} resets"))
            continue
        indices = np.asarray(found.resets.indices[i])[: number[i]].tolist()
        if indices != expected[i].indices:
            faults.append(Fault("events", f"lane {i}: {indices} instead of {expected[i].indices}"))
            continue
        times = np.asarray(found.resets.times[i])[:count]
        error = max(
            np.max(np.abs(times - expected[i].times), initial=0.0),
            np.max(np.abs(ys[i] - expected[i].y)) / (1 + np.max(np.abs(expected[i].y))),
        )
        numbers["error"] = max(numbers["error"], float(error))
        if not error < 1e-5:
            faults.append(Fault("error", f"lane {i}: {error:.1e}"))
    with_events = [i for i in judged if 0 < len(expected[i].times) < 12]
    if with_events and not faults:
        _check_gradients(one, *take(with_events[0]), faults, numbers)
    return numbers


def _check_gradients(
    one: Switched, args: Args, y0: np.ndarray, faults: list[Fault], numbers: dict[str, Any]
) -> None:
    """Reverse mode, forward mode and differences, of the end and of the times."""
    rng = np.random.default_rng((one.seed, one.index, 22))
    weights = jnp.asarray(rng.normal(size=one.size))

    def value(given: Any) -> jax.Array:
        sol = solution(one, *given)
        times = jnp.where(jnp.isfinite(sol.resets.times), sol.resets.times, 0.0)
        return sol.ys[0] @ weights + jnp.sum(times * jnp.cos(jnp.arange(MOST)))

    given = jax.tree.map(jnp.asarray, (args, y0))
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), given)
    gradient = jax.jit(jax.grad(value))(given)
    products = [
        jnp.vdot(g, d) for g, d in zip(*map(jax.tree.leaves, (gradient, along)), strict=True)
    ]
    reverse, size = float(sum(products)), float(sum(map(abs, products))) + 1.0
    forward = float(jax.jit(lambda x: jax.jvp(value, (x,), (along,))[1])(given))
    at = jax.jit(lambda h: value(jax.tree.map(lambda x, d: x + h * d, given, along)))
    h = 1e-5
    quotient = float((at(-2 * h) - 8 * at(-h) + 8 * at(h) - at(2 * h)) / (12 * h))
    numbers["modes"] = abs(reverse - forward) / size
    numbers["differences"] = abs(forward - quotient) / size
    if not numbers["modes"] < 1e-9:
        faults.append(Fault("modes", f"{reverse} in reverse mode, {forward} in forward mode"))
    if not numbers["differences"] < 1e-3:
        faults.append(Fault("gradient", f"{forward}, by differences {quotient}"))
