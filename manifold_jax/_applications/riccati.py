"""Riccati equations of linear-quadratic regulators, by doubling."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Twice as many steps each time: enough for intervals 4e9 times longer than the fastest motion.
_DOUBLINGS = 32
# What rounding may change of the solution, and of motions that are slow beside the fastest.
_ROUNDING, _ROUNDING_OF_SLOW = 1e-4, 1e-2


class _ControlledStep(NamedTuple):
    """States and costates over a length of time, `x1 = (1 + change) x0 - effort costate1` and
    `costate0 = cost x0 + (1 + change)^T costate1`. `effort` and `cost` are symmetric and not negative."""

    change: Float[Array, "*intervals d d"]
    effort: Float[Array, "*intervals d d"]
    cost: Float[Array, "*intervals d d"]


def solve_riccati(
    ts: Float[Array, " K"],
    A: Float[Array, "K d d"],
    push: Float[Array, "K d d"],
    Q: Float[Array, "K d d"],
    final: Float[Array, "d d"],
) -> Float[Array, "K d d"]:
    """Solve `-S' = A^T S + S A - S push S + Q` backwards from `S(ts[-1]) = final`, with the mean of the
    matrices over each interval.

    The exponential of a whole interval (Davison & Maki 1973) mixes motions that grow with those that decay,
    until rounding has removed the latter. One of a short step does not, and two steps together are a step
    of the controlled motion, which decays. What remains is growth that costs nothing: where rounding could
    be felt the solution is NaN, from there on backwards.

    Source: Anderson, Int. J. Control 28 (1978) 295-306 (doubling algorithms); Chu, Fan, Lin & Wang, Int. J.
    Control 77 (2004) 767-788 (that they preserve the structure, and how accurate they are).
    """
    mean = lambda values: (values[1:] + values[:-1]) / 2
    step = _over_intervals(jnp.diff(ts), mean(A), mean(push), mean(Q))

    def back(S: Array, step: _ControlledStep) -> tuple[Array, Array]:
        transition = _plus_one(step.change)
        controlled = jnp.linalg.solve(_plus_one(step.effort @ S), transition)
        S = _symmetric(step.cost + transition.T @ S @ controlled)
        return S, S

    final = _symmetric(final)
    _, S = jax.lax.scan(back, final, step, reverse=True)
    return jnp.concatenate([S, final[None]])


def _over_intervals(
    lengths: Float[Array, " intervals"],
    A: Float[Array, "intervals d d"],
    push: Float[Array, "intervals d d"],
    Q: Float[Array, "intervals d d"],
) -> _ControlledStep:
    """Double a short step of each interval until it is the interval."""
    H, units = jax.vmap(_hamiltonian)(lengths, A, push, Q)
    size = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(H), axis=1), axis=1, initial=0))
    number = jnp.clip(jnp.ceil(jnp.log2(size)), 0, _DOUBLINGS)
    step = jax.vmap(_short_step)(H / 2 ** number[:, None, None], units)

    def twice(carry: tuple[_ControlledStep, Array], k: Array) -> tuple[_ControlledStep, Array]:
        step = jax.vmap(_twice)(carry[0])
        new = step, jnp.maximum(carry[1], jax.vmap(_growth)(step))
        choose = jax.vmap(lambda more, new, old: jnp.where(more, new, old))
        return jax.tree.map(lambda new, old: choose(k < number, new, old), new, carry)

    def body(
        carry: tuple[_ControlledStep, Array], k: Array
    ) -> tuple[tuple[_ControlledStep, Array], None]:
        goes_on = k < jnp.max(number, initial=0)
        return jax.lax.cond(goes_on, twice, lambda carry, k: carry, carry, k), None

    start = step, jax.vmap(_growth)(step)
    (step, growth), _ = jax.lax.scan(body, start, jnp.arange(_DOUBLINGS, dtype=number.dtype))
    rounding = jnp.finfo(growth.dtype).eps
    lost = ~((growth * rounding < _ROUNDING) & (2**number * rounding < _ROUNDING_OF_SLOW))
    return step._replace(cost=jnp.where(lost[:, None, None], jnp.nan, step.cost))


def _hamiltonian(
    length: Float[Array, ""],
    A: Float[Array, "d d"],
    push: Float[Array, "d d"],
    Q: Float[Array, "d d"],
) -> tuple[Float[Array, "2*d 2*d"], Float[Array, ""]]:
    """Return the matrix of states and costates over an interval, and the unit of the cost in it: that with
    which `push` and `Q` are equally large, so that fewer steps are enough."""
    floor = float(jnp.finfo(A.dtype).tiny) ** 0.5  # either may be zero
    unit = jnp.sqrt((_largest(Q) + floor) / (_largest(push) + floor))
    return length * jnp.block([[A, -unit * push], [-Q / unit, -A.T]]), unit


def _short_step(H: Float[Array, "two_d two_d"], unit: Float[Array, ""]) -> _ControlledStep:
    """Return the step for a matrix that is not large (NaN if it is)."""
    d = H.shape[0] // 2
    flow = jax.scipy.linalg.expm(H, max_squarings=0)
    back = jnp.linalg.inv(flow[d:, d:])
    effort, cost = -flow[:d, d:] @ back / unit, -back @ flow[d:, :d] * unit
    return _ControlledStep(
        back.T - jnp.eye(d, dtype=back.dtype), _symmetric(effort), _symmetric(cost)
    )


def _twice(step: _ControlledStep) -> _ControlledStep:
    """Return the step of twice the length. Of the transition only what differs from the identity is kept, which is
    rounded less while steps are short."""
    change, effort, cost = step
    transition, mixed = _plus_one(change), effort @ cost
    both = jnp.concatenate([mixed, effort], axis=1)
    held, felt = jnp.split(jnp.linalg.solve(_plus_one(mixed), both), 2, axis=1)
    controlled = change - held @ transition
    return _ControlledStep(
        change + transition @ controlled,
        _symmetric(effort + transition @ felt @ transition.T),
        _symmetric(cost + transition.T @ cost @ _plus_one(controlled)),
    )


def _growth(step: _ControlledStep) -> Float[Array, ""]:
    """Return by how much squares grow, whatever the units of the coordinates."""
    transition = _plus_one(step.change)
    return _largest(transition * transition.T)


def _largest(matrix: Float[Array, "d d"]) -> Float[Array, ""]:
    return jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), initial=0))


def _plus_one(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    return matrix + jnp.eye(matrix.shape[0], dtype=matrix.dtype)


def _symmetric(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    return (matrix + matrix.T) / 2
