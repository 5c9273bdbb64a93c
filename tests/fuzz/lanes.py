"""The draws of a structure: one batch of lanes, as it is and with one lane that has to fail."""

from typing import Any

import numpy as np

from .families import Args
from .program import FRACTIONS, JUMP, level_function
from .reference import on_manifold, Paths, solve
from .structure import Structure


FAILING = 2
# Fewer draws of large systems.
LARGE, MOST_LARGE = 50, 12
# How far starts are off the manifold, where they are.
OFFSET = 1e-2
# Where events are put, as a fraction of the run.
EVENT = 0.6

Lanes = dict[str, Any]


def draw(structure: Structure, draws: int) -> Lanes:
    """Healthy lanes."""
    family = structure.family
    rng = np.random.default_rng((structure.seed, structure.index, 1))
    draws = min(draws, MOST_LARGE) if family.n > LARGE else draws
    args, y0 = family.draw(rng, draws)
    start = rng.uniform(-1.0, 1.0, draws)
    sign = {"forward": 1, "backward": -1}.get(structure.direction)
    sign = np.where(np.arange(draws) % 2 == 0, 1, -1) if sign is None else sign
    end = start + sign * family.span * rng.uniform(0.7, 1.0, draws)
    jump = rng.uniform(0.5, 1.5, draws) * np.where(rng.random(draws) < 0.5, 1, -1)
    common = {
        "start": start,
        "end": end,
        "rate": np.ones(draws),
        "jump": jump * structure.jumps,
        "jump_time": start + JUMP * (end - start),
        "spoilt": np.zeros(draws),
        "level": np.zeros(draws),
    }
    if structure.offset:
        y0 = y0 + OFFSET * rng.uniform(-1.0, 1.0, y0.shape)
    return {"start": start, "end": end, "y0": y0, "args": args | common}


def consistent(structure: Structure, lanes: Lanes) -> np.ndarray:
    """The starts, moved onto the manifold."""
    family = structure.family
    if family.mechanical or family.conserves or family.stiff:
        return lanes["y0"]  # they are there
    return on_manifold(family, lanes["start"], lanes["y0"], lanes["args"])


def with_events(structure: Structure, lanes: Lanes, paths: Paths) -> Lanes:
    """With levels that the event function reaches inside the run."""
    if structure.output != "event":
        return lanes
    level = level_function(np, paths(np.array([EVENT]))[0])
    return lanes | {"args": lanes["args"] | {"level": level}}


def with_failing_lane(structure: Structure, lanes: Lanes) -> Lanes:
    """The same but for one lane."""
    args, y0 = dict(lanes["args"]), lanes["y0"].copy()

    def spoil(name: str, value: float) -> None:
        args[name] = args[name].copy()
        args[name][FAILING] = value

    match structure.failing:
        case "nan-field":
            spoil("rate", np.nan)
        case "nan-start":
            y0[FAILING] = np.nan
        case "impossible" | "dependent":
            spoil("spoilt", 1.0)
        case "fast":
            spoil("rate", 1e7)
    return lanes | {"args": args, "y0": y0}


def reference_paths(structure: Structure, lanes: Lanes) -> Paths:
    return solve(structure.family, lanes["args"], consistent(structure, lanes), structure.jumps)


def amplification(structure: Structure, lanes: Lanes, paths: Paths) -> np.ndarray:
    """By how much small changes of the start grow, at most, for each lane."""
    rng = np.random.default_rng((structure.seed, structure.index, 2))
    change = rng.normal(size=lanes["y0"].shape)
    size = 1e-6
    change *= size / np.linalg.norm(change, axis=-1, keepdims=True)
    family = structure.family
    if family.exact(lanes["end"], lanes["y0"], lanes["args"]) is not None:
        return np.ones(len(change))
    y0 = consistent(structure, lanes) + change
    moved = solve(family, lanes["args"], y0, structure.jumps)
    growth = np.linalg.norm(moved(FRACTIONS) - paths(FRACTIONS), axis=-1) / size
    return np.maximum(1.0, growth.max(axis=0))  # NaN where there is no reference


def gradient_directions(structure: Structure, lanes: Lanes) -> Args:
    """Changes of the parameters, of their own size."""
    rng = np.random.default_rng((structure.seed, structure.index, 3))
    family = structure.family
    directions = {}
    for name in family.parameters:
        moves = name in ("forms", "shifts", "levels", "radii")
        if moves and structure.approach in ("error-metric", "weights"):
            continue  # the start is moved in another metric than that of the reference
        value = lanes["args"][name]
        direction = rng.normal(size=value.shape) * np.maximum(np.abs(value), 0.1)
        if name in ("forms", "masses") and value.ndim > 2:
            direction = (direction + np.swapaxes(direction, -1, -2)) / 2
        directions[name] = direction
    return directions


def moved_lanes(structure: Structure, lanes: Lanes, directions: Args, h: float) -> Lanes:
    """Lanes with other parameters, and what follows from them."""
    args = dict(lanes["args"])
    for name, direction in directions.items():
        args[name] = args[name] + h * direction
    return lanes | {"args": structure.family.settled(args, lanes["y0"])}


def take(lanes: Lanes, chosen: Any) -> Lanes:
    args = {name: value[chosen] for name, value in lanes["args"].items()}
    return {name: value[chosen] for name, value in lanes.items() if name != "args"} | {"args": args}
