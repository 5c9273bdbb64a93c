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


SECONDS = 0.2
# Of the numbers themselves, for differences: a damping does little, and a small change of it is rounded away.
SHIFTS = (5e-4, 2e-3, 3e-3)
CLOSED = 1e-9  # m
# m/s, of all bodies before joints take away what they do not allow: at rest, springs let some move by 0.2 mm only,
# and what a damping does to that is rounded.
PUSH = (1.0, -0.7, 1.3)


@dataclasses.dataclass(frozen=True)
class Gradient:
    """Derivatives by a length, a mass and the damping of a motor; in forward and in reverse mode the largest
    relative difference of these from central differences, and seconds to compile and of the run."""

    steps: int
    derivatives: tuple[float, ...]
    forward: float
    forward_compile_s: float
    forward_s: float
    reverse: float | None
    reverse_compile_s: float | None
    reverse_s: float | None


def measure(machine: Any, steps: int, by_reverse: bool) -> Gradient:
    """Differentiate the sum of squares of how far the bodies of `machine` are from its drawing at the end of so
    many equal steps. It has dampers in its motors."""
    place = _length(machine)
    numbers = jnp.stack([leaf[at] for leaf, at in zip(_leaves(machine), place, strict=True)])

    def end(numbers: Any, adjoint: Any) -> Any:
        changed = _changed(machine, place, numbers)
        system = changed.system
        q, v = changed.state(assemble=True)
        pushed = mj.multibody.Pose(v.position + jnp.array(PUSH), v.orientation)
        sol = mj.diffeqsolve(
            system.terms,
            mj.Projected(dfx.Tsit5(), system.constraint),
            0.0,
            SECONDS,
            SECONDS / steps,
            (q, pushed),
            adjoint=adjoint,
            max_steps=steps + 2,
        )
        moved = sol.ys[0].position[-1] - machine.bodies.drawing.position
        return jnp.sum(moved**2)

    def forward(numbers: Any) -> Any:
        along = lambda x: (end(x, dfx.ForwardMode()),) * 2
        return jax.jacfwd(along, has_aux=True)(numbers)

    def reverse(numbers: Any) -> Any:
        return jax.grad(lambda x: end(x, dfx.RecursiveCheckpointAdjoint()))(numbers), None

    program, compiling = _compiled(forward, numbers)
    (found, _), running = _timed(program, numbers)
    expected = _differences(lambda x: float(program(jnp.asarray(x))[1]), np.asarray(numbers))
    off = lambda found: float(np.max(np.abs(np.asarray(found) / expected - 1)))
    backwards: list[float | None] = [None, None, None]
    if by_reverse:
        program, reverse_compiling = _compiled(reverse, numbers)
        (other, _), reverse_running = _timed(program, numbers)
        backwards = [off(other), reverse_compiling, reverse_running]
    derivatives = tuple(np.asarray(found).tolist())
    return Gradient(steps, derivatives, off(found), compiling, running, *backwards)


def _leaves(machine: Any) -> tuple[Any, ...]:
    """Points of the most frequent kind of joint, masses, and dampings of motors."""
    hinges = max(machine.joints, key=lambda group: len(group.attachment.names))
    motors = next(load for load in machine.loads if hasattr(load, "hinge"))
    return hinges.attachment.points, machine.bodies.mass, motors.laws.damping


def _changed(machine: Any, place: Any, numbers: Any) -> Any:
    new = [leaf.at[at].set(x) for leaf, at, x in zip(_leaves(machine), place, numbers, strict=True)]
    return eqx.tree_at(_leaves, machine, new)


def _length(machine: Any) -> tuple[Any, ...]:
    """Return the places of the longest arm of such a joint with which loops can still be closed where all equations
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
        if gap(tuple(map(jnp.asarray, place)), SHIFTS[0] * points[place]) < CLOSED:
            return place, *rest
    raise ValueError("No length can be changed with all loops closed.")


def _differences(f: Any, numbers: np.ndarray) -> np.ndarray:
    found = []
    for i in range(len(numbers)):
        h = np.zeros_like(numbers)
        h[i] = SHIFTS[i] * numbers[i]
        near, far = f(numbers + h) - f(numbers - h), f(numbers + 2 * h) - f(numbers - 2 * h)
        found.append((8 * near - far) / (12 * h[i]))
    return np.array(found)


def _compiled(function: Any, numbers: Any) -> tuple[Any, float]:
    begin = time.perf_counter()
    program = jax.jit(function).lower(numbers).compile()
    return program, time.perf_counter() - begin


def _timed(program: Any, numbers: Any) -> tuple[Any, float]:
    begin = time.perf_counter()
    found = jax.block_until_ready(program(numbers))
    return found, time.perf_counter() - begin
