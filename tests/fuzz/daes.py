"""Random differential-algebraic equations of index 1 to 4, reduced and solved.

They are a family of `_fuzz_families` with its multipliers as unknowns, and with `extras`, unknowns
that other equations determine; in any order, and in any scale.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from .checks import Fault, IN_TOLERANCES, REGULAR, ROUND_OFF
from .families import Args, Family, Quadrics, Spheres
from .lanes import gradient_directions, Lanes, moved_lanes
from .matrices import Frames
from .mechanics import Linkage, MASSES
from .program import FRACTIONS
from .reference import regularity, solve as reference_solve, violations


EXTRAS = ("none", "implicit", "rate", "second rate")
SOLVERS = ("Tsit5", "Dopri8", "Rodas5P")
TOLERANCE = {"Tsit5": 1e-7, "Dopri8": 1e-9, "Rodas5P": 1e-7}
STEPS = 40
# All of the equations at what was returned, in units of their scale; derivatives are solved for.
RESIDUAL = 1e-9
# What is compared, and how far it may differ.
PAIRS = (
    ("reverse", "forward", 1e-9),
    ("forward over reverse", "forward over forward", 1e-6),
    ("differences", "forward", 1e-6),
)


@dataclasses.dataclass(frozen=True)
class Equations:
    """`F(t, x, x', args)` of one family, in the order and with the scales of `shuffle`."""

    index: int
    seed: int
    family: Family
    extra: str
    solver: str
    form: str
    # As in `Structure`.
    approach = "projected"
    shuffle: tuple[int, ...]
    scales: tuple[float, ...]

    @property
    def spec(self) -> str:
        return f"{self.family} | {self.extra} | {self.solver} | {self.form}"

    def __call__(self, t: Any, x: Any, xdot: Any, args: Args) -> Any:
        rows = self._motion(t, x, xdot, args) | self._extras(t, x, xdot, args)
        names = [list(rows)[i % len(rows)] for i in self.shuffle]
        order = dict.fromkeys([*names, *rows])
        scales = dict(zip(order, self.scales, strict=False))
        return tuple(scales[name] * rows[name] for name in order)

    def _motion(self, t: Any, x: Any, xdot: Any, args: Args) -> Args:
        family = self.family
        if isinstance(family, Linkage):
            q, v = x["position"], x["velocity"]
            normals = jax.jacfwd(lambda q: family.position(jnp, t, q, args))(q)
            masses = args["masses"]
            inertia = masses @ xdot["velocity"] if masses.ndim == 2 else masses * xdot["velocity"]
            force = family.force(jnp, t, q, v, args)
            return {
                "rates": xdot["position"] - v,
                "balance": inertia + normals.T @ x["multiplier"] - force,
                "constraint": family.position(jnp, t, q, args),
            }
        y = x["state"]
        normals = jax.jacfwd(lambda y: family.residual(jnp, t, y, args))(y)
        push = x["multiplier"] - multipliers(jnp, self, t, y)
        return {
            "balance": xdot["state"] - family.field(jnp, t, y, args) - normals.T @ push,
            "constraint": family.residual(jnp, t, y, args),
        }

    def _extras(self, t: Any, x: Any, xdot: Any, args: Args) -> Args:
        del args
        wave = jnp.sin(t + jnp.sum(x["position" if "position" in x else "state"]))
        if self.extra == "implicit":
            return {"implicit": x["w"] + 0.4 * jnp.sin(x["w"]) - wave}
        if self.extra == "none":
            return {}
        rows = {"wave": x["w"] - wave, "rate": x["rate"] - xdot["w"]}
        if self.extra == "second rate":
            rows["second rate"] = x["second"] - xdot["rate"]
        return rows

    def guess(self, y0: Any) -> Any:
        """All unknowns, those of the family where they belong."""
        family = self.family
        equations = family.m
        if isinstance(family, Linkage):
            q, v = jnp.split(y0, 2)
            x = {"position": q, "velocity": v}
            equations = len(family.parents)
        else:
            x = {"state": y0}
        count = {"none": 0, "implicit": 1, "rate": 2, "second rate": 3}[self.extra]
        x["multiplier"] = jnp.zeros(equations)
        return x | dict.fromkeys(("w", "rate", "second")[:count], jnp.zeros(()))

    def state(self, x: Any) -> Any:
        """What the family calls its state."""
        if "state" in x:
            return x["state"]
        return jnp.concatenate([x["position"], x["velocity"]], axis=-1)


def multipliers(xp: Any, equations: Equations, t: Any, y: Any) -> Any:
    """The multipliers of a family whose field is tangent: what was put in."""
    k = np.arange(equations.family.m)
    return xp.cos(xp.asarray(t)[..., None] + k) * (1 + xp.sin(xp.sum(y, axis=-1))[..., None])


def equations(index: int, seed: int) -> Equations:
    rng = np.random.default_rng((seed, index, 10))
    choose = lambda options: options[int(rng.integers(len(options)))]
    n = int(rng.integers(2, 6))
    parents = tuple(int(rng.integers(-1, i)) for i in range(int(rng.integers(1, 5))))
    family = choose((
        Quadrics(n, int(rng.integers(1, n)), bool(rng.random() < 0.5)),
        Spheres(int(rng.integers(1, 4)), 3),
        Frames(3, 2),
        Linkage(choose(MASSES[:3]), choose((2, 3)), parents, bool(rng.random() < 0.4), False),
        Linkage(choose(MASSES[:3]), choose((2, 3)), parents, bool(rng.random() < 0.4), False),
    ))  # fmt: skip
    solver = choose(SOLVERS)
    return Equations(
        index=index,
        seed=seed,
        family=family,
        extra=choose(EXTRAS),
        solver=solver,
        form=choose(("ode", "index-1")) if solver == "Rodas5P" else "ode",
        shuffle=tuple(int(i) for i in rng.integers(0, 60, 8)),
        scales=tuple(float(s) for s in 10 ** rng.uniform(-2, 2, 8)),
    )


def draw(one: Equations, draws: int) -> Lanes:
    rng = np.random.default_rng((one.seed, one.index, 11))
    args, y0 = one.family.draw(rng, draws)
    start = rng.uniform(-1.0, 1.0, draws)
    zero = np.zeros(draws)
    common = {"start": start, "rate": zero + 1, "jump": zero, "jump_time": start}
    end = start + one.family.span * rng.uniform(0.5, 0.8, draws)
    return {"start": start, "end": end, "y0": y0, "args": args | common | {"end": end}}


def examine(one: Equations, draws: int, faults: list[Fault]) -> dict[str, Any]:
    """Add what is wrong with what is returned; returns how large the errors were."""
    lanes = draw(one, draws)
    example = jax.tree.map(lambda leaf: leaf[0], lanes)
    dae = mj.reduce_dae(one, one.guess(example["y0"]), example["args"], form=one.form)
    found = jax.tree.map(np.asarray, jax.jit(jax.vmap(_solution(one, dae)))(lanes))
    numbers: dict[str, Any] = {"cases": draws, "index of the equations": dae.report.index}
    paths = reference_solve(one.family, lanes["args"], found["start"], False)
    expected = np.swapaxes(paths(FRACTIONS), 0, 1)
    trusted = _regular(one, lanes, expected)
    if np.any(trusted & ~found["okay"]):
        faults.append(Fault("refused", f"lanes {np.flatnonzero(trusted & ~found['okay'])}"))
    trusted &= found["okay"]
    _judge(one, lanes, found, expected, trusted, faults, numbers)
    faults += _check_gradients(one, dae, jax.tree.map(lambda x: x[trusted], lanes), numbers)
    return numbers


def _regular(one: Equations, lanes: Lanes, expected: np.ndarray) -> np.ndarray:
    """Lanes whose equations stay far from dependent, and that have a reference."""
    times = _times(lanes)
    conditions = [
        regularity(one.family, times[:, k], np.nan_to_num(expected[:, k]), lanes["args"])
        for k in range(len(FRACTIONS))
    ]
    finite = np.all(np.isfinite(expected), axis=(1, 2))
    return finite & (np.min(conditions, axis=0) > REGULAR)


def _times(lanes: Lanes) -> np.ndarray:
    return lanes["start"][:, None] + np.outer(lanes["end"] - lanes["start"], FRACTIONS)


def _judge(
    one: Equations,
    lanes: Lanes,
    found: Any,
    expected: np.ndarray,
    trusted: np.ndarray,
    faults: list[Fault],
    numbers: dict[str, Any],
) -> None:
    """Equations, constraints, states and multipliers at everything that was returned."""
    times = _times(lanes)
    residuals = np.max(found["residual"], axis=1, initial=0.0)
    each = [
        violations(one.family, times[:, k], found["states"][:, k], lanes["args"])
        for k in range(len(FRACTIONS))
    ]
    worst = np.max(each, axis=0)
    errors = np.max(np.abs(found["states"] - expected), axis=(1, 2))
    sizes = {"violation": worst, "error": errors, "residual": residuals}
    limits = {
        "violation": ROUND_OFF,
        "error": 1e3 * IN_TOLERANCES * TOLERANCE[one.solver],
        # In the index-1 form the highest derivatives are states of the solver, good to its tolerance.
        "residual": RESIDUAL if one.form == "ode" else IN_TOLERANCES * TOLERANCE[one.solver],
    }
    if not isinstance(one.family, Linkage):
        exact = np.stack(
            [
                multipliers(np, one, t, y)
                for t, y in zip(times.T, np.swapaxes(found["states"], 0, 1), strict=True)
            ]
        )
        gap = np.abs(np.swapaxes(found["multiplier"], 0, 1) - exact)
        sizes["multipliers"], limits["multipliers"] = gap.max(axis=(0, 2)), limits["residual"]
    for name, size in sizes.items():
        numbers[name] = float(np.max(size[trusted], initial=0.0))
        wrong = np.flatnonzero(trusted & ~(size <= limits[name]))
        if wrong.size > 0:
            faults.append(Fault(name, f"{size[wrong[0]]:.1e} in lane {wrong[0]}"))


def _solution(one: Equations, dae: mj.ReducedDAE) -> Callable[[Lanes], Any]:
    """Consistent start and solution of one lane, with all unknowns at `FRACTIONS`."""

    def run(lane: Lanes) -> Any:
        args = lane["args"]
        guess = one.guess(lane["y0"])
        z0, _ = dae.consistent_state(lane["start"], guess, args)
        sol = _solve(one, dae, lane, z0, adaptive=True)
        x, xdot = jax.vmap(dae.outputs, (0, 0, None))(sol.ts, sol.ys, args)
        values = jax.vmap(one, (0, 0, 0, None))(sol.ts, x, xdot, args)
        size = jax.vmap(_scale(one), (0, 0, 0, None))(sol.ts, x, xdot, args)
        largest = [jnp.max(jnp.abs(value.reshape(len(sol.ts), -1)), axis=1) for value in values]
        relative = [value / s for value, s in zip(largest, size, strict=True)]
        start, _ = dae.outputs(lane["start"], z0, args)
        return {
            "start": one.state(start),
            "states": one.state(x),
            "multiplier": x["multiplier"],
            "residual": jnp.stack(relative).max(0),
            "okay": sol.result == dfx.RESULTS.successful,
        }

    return run


def _scale(one: Equations) -> Callable[..., Any]:
    """For each equation, how much it changes with its unknowns, times their size."""

    def scale(t: Any, x: Any, xdot: Any, args: Args) -> Any:
        slopes = jax.jacfwd(lambda x, xdot: one(t, x, xdot, args), argnums=(0, 1))(x, xdot)
        sizes = jax.tree.map(lambda u: 1 + jnp.max(jnp.abs(u)), (x, xdot))
        sums = []
        for slope in slopes:
            terms = jax.tree.map(lambda d, s: jnp.max(jnp.abs(d), initial=0.0) * s, slope, sizes)
            sums.append(sum(jax.tree.leaves(terms)))
        return tuple(sums)

    return scale


def _solve(one: Equations, dae: Any, lane: Lanes, z0: Any, adaptive: bool) -> Any:
    times = lane["start"] + (lane["end"] - lane["start"]) * jnp.asarray(FRACTIONS)
    solver = getattr(mj if one.solver == "Rodas5P" else dfx, one.solver)()
    tolerance = TOLERANCE[one.solver]
    return mj.diffeqsolve(
        dae.terms,
        mj.Projected(solver, dae.constraint),
        lane["start"],
        lane["end"],
        None if adaptive else (lane["end"] - lane["start"]) / STEPS,
        z0,
        lane["args"],
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance)
        if adaptive
        else dfx.ConstantStepSize(),
        throw=False,
    )


def _check_gradients(
    one: Equations, dae: Any, lanes: Lanes, numbers: dict[str, Any]
) -> list[Fault]:
    """Modes against each other and against differences, the consistent start included; second
    derivatives, which take minutes to compile, of every third structure."""
    lanes = jax.tree.map(lambda leaf: leaf[:3], lanes)
    if len(lanes["start"]) == 0:
        return []
    along = gradient_directions(one, lanes)
    chosen = {name: lanes["args"][name] for name in along}
    loss = _loss(one, dae)
    got = {
        name: np.asarray(jax.jit(jax.vmap(slope))(chosen, lanes, along))
        for name, slope in _slopes(loss, with_second=one.index % 3 == 0).items()
    }
    program = jax.jit(jax.vmap(loss))
    h = 1e-4
    ends = [np.asarray(program(moved_lanes(one, lanes, along, k * h))) for k in (1, -1, 2, -2)]
    got["differences"] = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
    faults = []
    for a, b, limit in PAIRS:
        if a not in got:
            continue
        gap = np.abs(got[a] - got[b]) / np.maximum(1.0, np.abs(got[b]))
        numbers[a] = float(np.max(gap))
        if not np.all(gap <= limit):
            worst = int(np.argmax(np.nan_to_num(gap, nan=np.inf)))
            text = f"{got[a][worst]:.9g} by {a}, {got[b][worst]:.9g} by {b}, lane {worst}"
            faults.append(Fault("gradient", text))
    return faults


def _loss(one: Equations, dae: Any) -> Callable[[Lanes], Any]:
    """A weighted sum of a state inside of the run and of all unknowns at its end."""

    def loss(lane: Lanes) -> Any:
        z0, _ = dae.consistent_state(lane["start"], one.guess(lane["y0"]), lane["args"])
        sol = _solve(one, dae, lane, z0, adaptive=False)
        last, _ = dae.outputs(sol.ts[-1], sol.ys[-1], lane["args"])
        leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves((sol.ys[2], last))]
        every = jnp.concatenate(leaves)
        return jnp.sum(jnp.cos(1 + jnp.arange(every.size)) * every)

    return loss


def _slopes(loss: Callable[[Lanes], Any], with_second: bool) -> dict[str, Callable]:
    """Functions of the parameters, a lane and a direction."""

    def of(parameters: Args, lane: Lanes) -> Any:
        return loss(lane | {"args": lane["args"] | parameters})

    def reverse(parameters: Args, lane: Lanes, step: Args) -> Any:
        gradient = jax.grad(of)(parameters, lane)
        return sum(jnp.vdot(gradient[name], step[name]) for name in step)

    def forward(parameters: Args, lane: Lanes, step: Args) -> Any:
        return jax.jvp(lambda p: of(p, lane), (parameters,), (step,))[1]

    def second(first: Any) -> Any:
        return lambda parameters, lane, step: jax.jvp(
            lambda p: first(p, lane, step), (parameters,), (step,)
        )[1]

    slopes = {"reverse": reverse, "forward": forward}
    if with_second:
        slopes["forward over reverse"] = second(reverse)
        slopes["forward over forward"] = second(forward)
    return slopes
