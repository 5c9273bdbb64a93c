"""Derivatives of a short swing of a robot by numbers of its file, against central differences."""

import dataclasses
import time
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


mb = mj.multibody
SECONDS = 0.2
SHIFT = 2e-3  # of the number itself, for differences
CLOSED = 1e-9  # m


@dataclasses.dataclass(frozen=True)
class Gradient:
    """Derivatives by a length, a mass and the damping of a motor, largest relative difference between these
    and central differences in forward and in reverse mode, and seconds: to compile, and of the run."""

    steps: int
    derivatives: tuple[float, ...]
    forward: float
    reverse: float | None
    forward_first_s: float
    forward_s: float
    reverse_first_s: float | None
    reverse_s: float | None


def measure(machine: Any, steps: int, reverse: bool = True) -> Gradient:
    """`machine` has dampers in its motors; so many equal steps."""
    place = _length(machine)
    numbers = jnp.stack([leaf[at] for leaf, at in zip(_leaves(machine), place, strict=True)])

    def end(numbers: Any, adjoint: Any) -> Any:
        changed = _changed(machine, place, numbers)
        system = changed.system
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            SECONDS,
            SECONDS / steps,
            changed.state(assemble=True),
            adjoint=adjoint,
            max_steps=steps + 2,
        )
        return jnp.sum(sol.ys[0].position ** 2)

    program = jax.jit(lambda x: end(x, dfx.ForwardMode()))
    forwards = jax.jit(jax.jacfwd(lambda x: end(x, dfx.ForwardMode())))
    expected = _differences(lambda x: float(program(x)), np.asarray(numbers))
    found, *times = _timed(forwards, numbers)
    off = lambda found: float(np.max(np.abs(found / expected - 1)))
    backwards, of_reverse = None, [None, None]
    if reverse:
        adjoint = dfx.RecursiveCheckpointAdjoint()
        backwards, *of_reverse = _timed(jax.jit(jax.grad(lambda x: end(x, adjoint))), numbers)
    return Gradient(
        steps,
        tuple(found.tolist()),
        off(found),
        None if backwards is None else off(backwards),
        *times,
        *of_reverse,
    )


def _leaves(machine: Any) -> tuple[Any, ...]:
    """Points of hinges, masses, and dampings of motors."""
    hinges = next(group for group in machine.joints if group.kind is mb.Revolute)
    motors = next(load for load in machine.loads if hasattr(load, "hinge"))
    return hinges.attachment.points, machine.bodies.mass, motors.laws.damping


def _changed(machine: Any, place: Any, numbers: Any) -> Any:
    new = [leaf.at[at].set(x) for leaf, at, x in zip(_leaves(machine), place, numbers, strict=True)]
    return eqx.tree_at(_leaves, machine, new)


def _length(machine: Any) -> tuple[Any, ...]:
    """Return the places of the longest arm of a hinge with which loops can still be closed where all equations
    are counted, of the heaviest body, and of the first motor."""
    points, masses, _ = map(np.asarray, _leaves(machine))
    rest = (int(np.argmax(masses)),), (0,)

    @eqx.filter_jit
    def gap(place: Any, shift: Any) -> Any:
        length = _leaves(machine)[0]
        changed = eqx.tree_at(lambda a: _leaves(a)[0], machine, length.at[place].add(shift))
        gaps = changed.gaps(changed.state(assemble=True)[0])
        return jnp.max(jnp.abs(jnp.concatenate([part.reshape(-1) for part in gaps.values()])))

    for number in np.argsort(-np.abs(points).reshape(-1)):
        place = tuple(int(i) for i in np.unravel_index(number, points.shape))
        if gap(tuple(map(jnp.asarray, place)), SHIFT * points[place]) < CLOSED:
            return place, *rest
    raise ValueError("No length can be changed with all loops closed.")


def _differences(f: Any, numbers: np.ndarray) -> np.ndarray:
    found = []
    for i in range(len(numbers)):
        h = np.zeros_like(numbers)
        h[i] = SHIFT * numbers[i]
        near, far = f(numbers + h) - f(numbers - h), f(numbers + 2 * h) - f(numbers - 2 * h)
        found.append((8 * near - far) / (12 * h[i]))
    return np.array(found)


def _timed(program: Any, numbers: Any) -> tuple[Any, float, float]:
    """Return the result, and seconds of the first and of the second call."""
    times, found = [], None
    for _ in range(2):
        begin = time.perf_counter()
        found = np.asarray(jax.block_until_ready(program(numbers)))
        times.append(time.perf_counter() - begin)
    return found, times[0], times[1]
