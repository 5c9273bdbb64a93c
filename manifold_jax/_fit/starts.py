"""Several starts of a fit: their choice, and the best result."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .objective import Objective, weighted
from .optimize import look, optimize, OptimizerOutcome, Options
from .parameters import Transform
from .report import Start
from .setup import refuse_tracers


# Other starts of a parameter with one bound are up to this factor nearer to it or farther away.
_FACTOR = 3.0
# Number of points for each other start, of which those with the lowest losses are taken.
_POINTS = 8
# Losses that differ by less belong to one optimum.
_SAME = 1e-6


class Seen(NamedTuple):
    """The loss at one point, the solves that fail there, and the largest residual of the others."""

    loss: float
    failed: np.ndarray
    largest: float


def draw_points(transform: Transform, starts: int, seed: int) -> np.ndarray:
    """Draw unknowns `(points, p)`: the given start, and a Latin hypercube around it."""
    s, a, b = (np.asarray(x) for x in (transform.start, transform.lower, transform.upper))
    given = np.zeros((1, s.size))
    if starts == 1:
        return given
    from scipy.stats import qmc  # takes half a second to import, needed for several starts only

    cube = qmc.LatinHypercube(s.size, rng=np.random.default_rng(seed)).random(
        _POINTS * (starts - 1)
    )
    one, both = np.isfinite(a) | np.isfinite(b), np.isfinite(a) & np.isfinite(b)
    around = np.where(one, np.log(_FACTOR), 1.0) * (2 * cube - 1)
    given_place = np.where(both, s - a, 1.0) / np.where(both, b - a, 2.0)
    logit = lambda place: np.log(place / (1 - place))
    within = logit(cube) - logit(given_place)
    return np.concatenate([given, np.where(both, within, around)])


def see(u: Any, objective: Objective, options: Options) -> Seen:
    loss, solved = look(u, objective, options)
    refuse_tracers(model=loss)
    failed = np.asarray(solved.values.failed) > 0
    r = np.abs(np.asarray(weighted(objective, solved.values))[~failed])
    return Seen(float(loss), failed, float(np.max(r, initial=0.0)))


def choose(
    points: list[Any], given: Seen, objective: Objective, options: Options
) -> tuple[list[Any], list[Seen]]:
    """Choose the given start, the first of `points`, and of the others those with the fewest failures,
    then with the lowest losses."""
    seen = [given]
    if options.starts > 1:
        options.meter.begin("fit: looking for starts", len(points) - 1)
    for u in points[1:]:
        seen.append(see(u, objective, options))
        options.meter.advance(seen[-1].loss)
    usable = [i for i, at in enumerate(seen) if i > 0 and not np.all(at.failed)]
    others = sorted(usable, key=lambda i: (np.sum(seen[i].failed), seen[i].loss))
    best = [0, *others[: options.starts - 1]]
    return [points[i] for i in best], [seen[i] for i in best]


def with_scales(objective: Objective, seen: list[Seen]) -> Objective:
    """Set the penalty: a failed solve counts ten times the largest residual at all starts."""
    if np.all([at.failed for at in seen]):
        raise ValueError(
            "`parameters`: every solve from the start values fails (or its derivatives are not "
            "finite), so that there is nothing to improve. Check them with `mj.diffeqsolve`, "
            "start elsewhere, or raise `max_steps`."
        )
    largest = max([1.0, *(at.largest for at in seen)])
    data = np.max(np.abs(np.asarray(objective.pieces.weights * objective.pieces.data)))
    penalty = jnp.asarray(10 * max(largest, data), objective.penalty.dtype)
    return eqx.tree_at(lambda o: o.penalty, objective, penalty)


def optimize_all(
    objective: Objective, points: list[Any], seen: list[Seen], options: Options
) -> tuple[OptimizerOutcome, tuple[Start, ...]]:
    """Optimize one start after the other with the same compiled program, as compiling takes longer than
    a few fits. Return the best, and a table of all with the best first."""
    best, rows, several = None, [], len(points) > 1
    like = lambda u: jtu.tree_map(np.asarray, objective.transform.parameters(u))
    for number, (u, at) in enumerate(zip(points, seen, strict=True), 1):
        if np.all(at.failed):
            rows.append(Start(like(u), like(u), np.inf, 0, False, "every solve fails"))
            continue
        name = f"fit: start {number} of {len(points)}" if several else "fit"
        options.meter.begin(name, options.steps, listed=several)
        found = optimize(objective, u, options)
        options.meter.end(found.loss, found.message)
        steps = len(found.losses)
        rows.append(Start(like(u), like(found.u), found.loss, steps, found.success, found.message))
        if best is None or _better(found, best):
            best, chosen = found, rows[-1]
    others = sorted((row for row in rows if row is not chosen), key=lambda row: row.loss)
    return best, (chosen, *others)  # pyright: ignore[reportReturnType]


def _better(new: OptimizerOutcome, old: OptimizerOutcome) -> bool:
    """Whether the new result is better; of the same optimum, the one where the optimizer converged."""
    if abs(new.loss - old.loss) <= _SAME * abs(old.loss) and new.success != old.success:
        return new.success
    return new.loss < old.loss
