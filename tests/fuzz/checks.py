"""Checks of what a batch returned, against NumPy and SciPy."""

import dataclasses
from typing import Any

import diffrax as dfx
import numpy as np

from .lanes import FAILING, Lanes, take
from .program import CODES, level_function
from .reference import Paths, regularity, runge_kutta, violations
from .structure import IMPLICIT, LOW_ORDER, SPLIT, Structure


EPS = 2.0**-52
# Scaled residual of values that are on the manifold; the library promises 50 rounding units.
ROUND_OFF = 100 * EPS
# A lane can be judged if its equations are that far from dependent, and if its solution does not
# amplify errors more than that.
REGULAR, MOST_AMPLIFIED = 0.05, 1e3
# Times at which that is asked.
LOOKS = 21
# Errors that are plausible: in tolerances, or in errors of a Runge-Kutta method in NumPy.
IN_TOLERANCES, IN_YARDSTICKS = 20.0, 20.0
# Points of a lane that are compared, points of all lanes of which violations are computed.
PER_LANE, MOST_POINTS = 6, 4000


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something wrong: of which kind, and what was found."""

    kind: str
    message: str


@dataclasses.dataclass(frozen=True)
class Judge:
    """What is known of the healthy lanes from elsewhere.

    - `trusted`: the lanes that have to succeed.
    - `bound`: plausible errors at steps, relative to `1 + |y|`, for each lane.
    - `between`: what is added to it between steps.
    """

    paths: Paths
    growth: np.ndarray
    trusted: np.ndarray
    bound: np.ndarray
    between: float


def judge(structure: Structure, lanes: Lanes, paths: Paths, growth: np.ndarray) -> Judge:
    grid = np.linspace(0.0, 1.0, LOOKS)
    times = lanes["start"] + grid[:, None] * (lanes["end"] - lanes["start"])
    conditions = [
        regularity(structure.family, t, np.nan_to_num(y), lanes["args"])
        for t, y in zip(times, paths(grid), strict=True)
    ]
    regular = np.min(conditions, axis=0) > REGULAR
    step = 1 / structure.steps
    if structure.is_adaptive:
        # Methods of low order take many steps; stiff solvers lose some of their order.
        more = {"ImplicitEuler": 20}.get(
            structure.solver, 1 + 2 * (structure.solver in (*LOW_ORDER, "Bosh3"))
        )
        more = 10 if structure.family.stiff else more
        between = IN_TOLERANCES * structure.tolerance * more
        bound = between * growth
    else:
        bound = IN_YARDSTICKS * _yardstick(structure, lanes, paths) + 1e-10 * growth
        between = step**2 if structure.solver in LOW_ORDER else 10 * step**4
    return Judge(paths, growth, regular & (growth < MOST_AMPLIFIED), bound, between)


def _yardstick(structure: Structure, lanes: Lanes, paths: Paths) -> np.ndarray:
    """Errors of the same method, or of a simple one of low order, for each lane."""
    grid = np.linspace(0.0, 1.0, structure.steps + 1)
    name = structure.solver
    simple = {
        "HalfSolver": "Heun",
        "Sil3": "Heun",
        "Euler": "Midpoint",
        "ImplicitEuler": "Midpoint",
    }
    name = simple.get(name, "Bosh3" if name in IMPLICIT + SPLIT else name)
    tableau = getattr(dfx, name)().tableau
    expected = paths(grid)
    found = runge_kutta(structure.family, lanes["args"], expected[0], grid, tableau)
    errors = np.max(_relative(found, expected), axis=0)
    # Midpoint has half an order of magnitude more digits than Euler at these steps, squared.
    return np.sqrt(errors) if structure.solver in ("Euler", "ImplicitEuler") else errors


def _relative(states: np.ndarray, reference: np.ndarray) -> np.ndarray:
    size = 1 + np.max(np.abs(reference), axis=-1)
    return np.max(np.abs(states - reference), axis=-1) / size


def check_results(structure: Structure, judge: Judge, found: Any, failed: Any) -> list[Fault]:
    """Result codes, and NaN where there is success."""
    faults = []
    okay = is_okay(found["code"])
    # Newton's method does not always find the time of an event, with plain solvers, too.
    unfound = found["code"] == CODES.index("nonlinear_max_steps_reached")
    unfound &= structure.output == "event"
    refused = np.flatnonzero(judge.trusted & ~okay & ~unfound)
    if refused.size > 0:
        codes = sorted({CODES[c] if c >= 0 else "other" for c in found["code"][refused]})
        text = (
            f"{refused.size} of {okay.size} lanes refused ({', '.join(codes)}), first {refused[0]}"
        )
        faults.append(Fault("refused", text))
    for name, result in (("healthy", found), ("with a failing lane", failed)):
        used = np.isfinite(result["times"])
        wrong = used & ~np.all(np.isfinite(result["states"]), axis=-1)
        lanes = np.flatnonzero(is_okay(result["code"]) & (wrong.any(axis=1) | ~used.any(axis=1)))
        if lanes.size > 0:
            faults.append(Fault("not finite", f"{name}: success with NaN in lane {lanes[0]}"))
    hopeless = structure.failing in ("nan-field", "nan-start", "impossible", "dependent")
    early = structure.output == "event" and structure.failing == "impossible"
    if hopeless and not early and is_okay(failed["code"])[FAILING]:
        faults.append(Fault("silent", f"success in the lane with {structure.failing}"))
    return faults


def is_okay(code: np.ndarray) -> np.ndarray:
    return (code == CODES.index("successful")) | (code == CODES.index("event_occurred"))


def check_other_lanes(found: Any, failed: Any) -> list[Fault]:
    """Bit for bit the same, whatever happens in the failing lane."""
    faults = []
    for name, value in found.items():
        others = np.delete(np.arange(len(value)), FAILING)
        same = np.array_equal(value[others], failed[name][others], equal_nan=True)
        if not same:
            faults.append(Fault("lanes", f"{name} of other lanes changes with a failing lane"))
    return faults


def check_violations(
    structure: Structure, lanes: Lanes, judge: Judge, found: Any, failed: Any
) -> tuple[list[Fault], float]:
    """Constraints at all values returned; returns the largest violation, too."""
    okay = is_okay(found["code"])
    which, k = _points(structure, found, okay)
    values = _violations_at(structure, lanes, found, which, k)
    between = judge.between * (structure.output not in ("t1", "steps"))
    strict = structure.is_corrected or structure.approach == "steps-only"
    # A row of `n` numbers adds up as many errors, and is measured by its largest one.
    loose = structure.family.n * (judge.bound[which] + between)
    limit = np.full(which.shape, ROUND_OFF) if strict else loose
    faults = []
    wrong = np.flatnonzero((values > limit) & (judge.trusted[which] | strict))
    if wrong.size > 0:
        worst = wrong[np.argmax(values[wrong])]
        text = f"{values[worst]:.1e} in lane {which[worst]}, {wrong.size} values above {limit[worst]:.1e}"
        faults.append(Fault("violation", text))
    if structure.failing == "impossible" and structure.is_corrected:
        faults += _check_before_failure(structure, lanes, failed)
    return faults, float(np.max(values, initial=0.0))


def _check_before_failure(structure: Structure, lanes: Lanes, failed: Any) -> list[Fault]:
    """Values of the failing lane before its equations lose their solution."""
    times = failed["times"][FAILING]
    length = lanes["end"][FAILING] - lanes["start"][FAILING]
    early = (times - lanes["start"][FAILING]) / length <= 0.5
    k = np.flatnonzero(early & np.all(np.isfinite(failed["states"][FAILING]), axis=-1))
    which = np.full(k.shape, FAILING)
    values = _violations_at(structure, lanes, failed, which, k)
    worst = float(np.max(values, initial=0.0))
    if worst > ROUND_OFF:
        return [Fault("violation", f"{worst:.1e} in the failing lane, before it fails")]
    return []


def _points(structure: Structure, found: Any, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lanes and rows of finite values, some of them if there are many."""
    finite = np.isfinite(found["times"]) & np.all(np.isfinite(found["states"]), axis=-1)
    which, k = np.nonzero(finite & chosen[:, None])
    most = MOST_POINTS if structure.family.n <= 50 else MOST_POINTS // 50
    if which.size > most:
        some = np.random.default_rng(structure.seed).choice(which.size, most, replace=False)
        which, k = which[some], k[some]
    return which, k


def _violations_at(structure, lanes, found, which, k) -> np.ndarray:
    args = take(lanes, which)["args"]
    return violations(structure.family, found["times"][which, k], found["states"][which, k], args)


def check_accuracy(
    structure: Structure, lanes: Lanes, judge: Judge, found: Any
) -> tuple[list[Fault], float, float]:
    """Errors of states; returns the largest one, and the largest in units of its bound."""
    worst, largest, where = 0.0, 0.0, ""
    length = lanes["end"] - lanes["start"]
    between = judge.between * (structure.output not in ("t1", "steps"))
    for i in np.flatnonzero(judge.trusted & is_okay(found["code"])):
        k = np.flatnonzero(np.isfinite(found["times"][i]))
        k = k[np.linspace(0, k.size - 1, min(PER_LANE, k.size)).astype(int)]
        s = np.clip((found["times"][i, k] - lanes["start"][i]) / length[i], 0.0, 1.0)
        error = np.max(_relative(found["states"][i, k], judge.paths(s)[:, i]), initial=0.0)
        ratio = error / (judge.bound[i] + between)
        largest = max(largest, float(error))
        if not ratio <= worst:
            worst, where = (
                float(ratio),
                f"error {error:.1e} in lane {i}, growth {judge.growth[i]:.0f}",
            )
    faults = [Fault("error", f"{where}: {worst:.1f} of what is plausible")] if worst > 1 else []
    return faults, largest, worst


def check_events(structure: Structure, lanes: Lanes, judge: Judge, found: Any) -> list[Fault]:
    """The event function is zero at the end, and no crossing was overlooked but for pairs."""
    if structure.output != "event":
        return []
    s = np.linspace(0.0, 1.0, 801)
    level, length = lanes["args"]["level"], lanes["end"] - lanes["start"]
    off = 10 * (judge.bound + judge.between) * (1 + np.abs(level))
    crossings = _crossings(level_function(np, judge.paths(s)) - level, off)
    happened = found["code"] == CODES.index("event_occurred")
    for i in np.flatnonzero(judge.trusted & is_okay(found["code"])):
        fraction = (found["times"][i, -1] - lanes["start"][i]) / length[i]
        before = crossings[int(np.clip(fraction * 800, 0, 799)), i]
        expected = level_function(np, judge.paths(np.array([fraction]))[0, i]) - level[i]
        value = level_function(np, found["states"][i, -1]) - level[i]
        if happened[i] and abs(value) > 1e-6:
            return [Fault("event", f"the function is {value:.1e} at the event of lane {i}")]
        if happened[i] and before % 2 == 1 and abs(expected) > off[i]:
            return [Fault("event", f"lane {i} went on beyond a crossing")]
        if not happened[i] and crossings[-1, i] % 2 == 1:
            return [Fault("event", f"lane {i} met no event")]
    return []


def _crossings(values: np.ndarray, off: np.ndarray) -> np.ndarray:
    """How often the sign has changed so far, values closer to zero than `off` left out."""
    signs = np.where(np.abs(values) > off, np.sign(values), 0)
    for k in range(1, len(signs)):
        signs[k] = np.where(signs[k] == 0, signs[k - 1], signs[k])
    return np.cumsum(signs[1:] * signs[:-1] < 0, axis=0)


def check_single(
    structure: Structure, judge: Judge, found: Any, alone: Any, lane: int
) -> tuple[list[Fault], float]:
    """A lane alone is the same but for rounding; returns the largest difference.

    The end of a step depends on error estimates, and with them on rounding, by less than the
    tolerance, also in plain Diffrax: what the state moves in between is no difference."""
    steps = int(found["num_steps"][lane]), int(alone["num_steps"])
    times, states = found["times"][lane], found["states"][lane]
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.abs(times - alone["times"])[:, None]
        speed = np.abs(np.diff(states, axis=0) / np.diff(times)[:, None])
        apart = np.where(apart <= structure.tolerance, apart, 0.0)
        moved = apart * np.max(speed, axis=0, initial=0.0, where=np.isfinite(speed))
        difference = (np.abs(states - alone["states"]) - moved) / (1 + np.abs(states))
    largest = float(np.nanmax(difference, initial=0.0))
    limit = 1e-11 * judge.growth[lane]
    if largest > limit or found["code"][lane] != alone["code"] or steps[0] != steps[1]:
        text = f"differs by {largest:.1e} alone and in the batch, {steps[1]} and {steps[0]} steps"
        return [Fault("single", text)], largest
    return [], largest
