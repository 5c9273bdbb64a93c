"""The conditions of all resets as one vector of numbers, and their jumps."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from .._base.compat import nondifferentiable
from .._base.shapes import are_alike, shapes
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from .reset import Reset, ResetAt


_NO_DERIVATIVE = (
    "The time at which a Boolean `condition` of an `mj.Reset` becomes true has no derivative. Write it as a real number "
    "that crosses zero, for example `y[0] - 1.0` with `direction=True` instead of `y[0] > 1.0`."
)


class Conditions(eqx.Module):
    """The conditions and jumps of a solve, in the order of `resets`, as functions of the true time."""

    resets: list[Reset | ResetAt]
    args: Args
    is_boolean: tuple[bool, ...] = eqx.field(static=True)

    @staticmethod
    def of(resets: Sequence[Reset | ResetAt], t: RealScalarLike, y: Y, args: Args) -> "Conditions":
        """Check the functions of the resets; `t` and `y` are examples of a time and a state."""
        resets = [r.with_times(args) if isinstance(r, ResetAt) else r for r in resets]
        kinds = [_is_boolean(i, reset, t, y, args) for i, reset in enumerate(resets)]
        for i, reset in enumerate(resets):
            _check_jump(i, reset, t, y, args)
        return Conditions(resets, args, tuple(kinds))

    def __len__(self) -> int:
        return len(self.resets)

    @property
    def samples(self) -> int:
        return max(r.samples if isinstance(r, Reset) else 1 for r in self.resets)

    @property
    def num_known_times(self) -> int:
        return sum(r.times.size for r in self.resets if isinstance(r, ResetAt))  # pyright: ignore

    @property
    def is_time_nan(self) -> BoolScalar:
        """Whether one of the known times is NaN, which is after all others: it would never be met."""
        known = [r.times for r in self.resets if isinstance(r, ResetAt)]
        found = [jnp.any(jnp.isnan(times)) for times in known]  # pyright: ignore
        return jnp.any(jnp.asarray([jnp.asarray(False), *found]))

    @property
    def directions(self) -> list[int]:
        """Return 1 for events where a condition increases, -1 where it decreases, 0 for both."""
        signs = {True: 1, False: -1, None: 0}
        kinds = zip(self.resets, self.is_boolean, strict=True)
        return [
            1 if isinstance(r, ResetAt) or boolean else signs[r.direction] for r, boolean in kinds
        ]

    @property
    def most(self) -> Int[Array, " resets"]:
        """How often each can happen in a solve."""
        limit = jnp.iinfo(jnp.int32).max
        most = [r.max_number if isinstance(r, Reset) else None for r in self.resets]
        return jnp.asarray([limit if m is None else m for m in most], jnp.int32)

    def values(self, t: FloatScalar, y: Y) -> Float[Array, " resets"]:
        """Return the values of the conditions; 1 or -1 if they are Boolean, and -1 for known times."""

        def value(reset: Reset | ResetAt, boolean: bool) -> Array:
            if isinstance(reset, ResetAt):
                return -jnp.ones_like(t)
            value = jnp.asarray(reset.condition(t, y, self.args))
            return jnp.where(value, 1, -1).astype(t.dtype) if boolean else value.astype(t.dtype)

        return jnp.stack([value(*of) for of in zip(self.resets, self.is_boolean, strict=True)])

    def is_known(self, number: IntScalar) -> BoolScalar:
        """Whether the times of the reset `number` are known before the solve."""
        return jnp.asarray([isinstance(r, ResetAt) for r in self.resets])[number]

    def distance(self, number: IntScalar, t: FloatScalar, y: Y) -> FloatScalar:
        """Return a function of `t` and `y` that is zero at the event `number`; for a Boolean condition it is
        zero everywhere."""

        def of(reset: Reset | ResetAt, boolean: bool) -> Any:
            if isinstance(reset, ResetAt):
                times = jnp.append(reset.times.astype(t.dtype), jnp.inf)  # there may be none
                nearest = jnp.argmin(jnp.abs(jax.lax.stop_gradient(times - t)))
                return lambda t, y: t - times[nearest]
            if boolean:
                return lambda t, y: jnp.zeros_like(t)
            return lambda t, y: jnp.asarray(reset.condition(t, y, self.args)).astype(t.dtype)

        branches = [of(*pair) for pair in zip(self.resets, self.is_boolean, strict=True)]
        return jax.lax.switch(number, branches, t, y)

    def refuse_derivative(self, t: FloatScalar, y: Y) -> Y:
        """Return `y`, with an error if it is differentiated, if a Boolean condition depends on the state."""
        kinds = zip(self.resets, self.is_boolean, strict=True)
        if any(boolean and _depends_on_state(r, t, y, self.args) for r, boolean in kinds):
            return nondifferentiable(y, msg=_NO_DERIVATIVE)
        return y

    def jump(self, number: IntScalar, t: FloatScalar, y: Y) -> Y:
        def of(reset: Reset | ResetAt) -> Any:
            return lambda t, y: jtu.tree_map(
                lambda new, old: jnp.asarray(new, old.dtype), reset.jump(t, y, self.args), y
            )

        return jax.lax.switch(number, [of(reset) for reset in self.resets], t, y)

    def next_times(
        self, t0: FloatScalar, happened: Int[Array, " resets"], direction: RealScalarLike
    ) -> Float[Array, " resets"]:
        """Return the next of the known times of each reset, in the time of Diffrax; infinity for
        conditions, and after the last one. `t0` is the start of the solve."""

        def following(reset: Reset | ResetAt, happened: IntScalar) -> FloatScalar:
            if isinstance(reset, Reset) or reset.times.size == 0:
                return jnp.full_like(t0, jnp.inf)
            times = jnp.sort(reset.times.astype(t0.dtype) * direction)
            times = jnp.append(times, jnp.asarray(jnp.inf, t0.dtype))
            first = jnp.searchsorted(times, t0, side="left").astype(happened.dtype)
            return times[jnp.minimum(first + happened, times.size - 1)]

        return jnp.stack([following(r, happened[i]) for i, r in enumerate(self.resets)])

    def true_at_start(self, t: RealScalarLike, y: Y) -> Bool[Array, " resets"]:
        """Return which Boolean conditions are true at the start."""
        return (self.values(jnp.asarray(t), y) > 0) & jnp.asarray(self.is_boolean)


def _is_boolean(i: int, reset: Reset | ResetAt, t: RealScalarLike, y: Y, args: Args) -> bool:
    if isinstance(reset, ResetAt):
        return False
    out = eqx.filter_eval_shape(reset.condition, t, y, args)
    leaves = jtu.tree_leaves(out)
    if len(leaves) != 1 or jnp.shape(leaves[0]) != ():
        raise ValueError(
            f"`resets[{i}].condition` must return one real number (or a Boolean), got {shapes(out)}."
        )
    dtype = jnp.result_type(leaves[0])
    is_boolean = jnp.issubdtype(dtype, jnp.bool_)
    if not is_boolean and not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(
            f"`resets[{i}].condition` must return one real number (or a Boolean), got the dtype {dtype}."
        )
    return is_boolean


def _check_jump(i: int, reset: Reset | ResetAt, t: RealScalarLike, y: Y, args: Args) -> None:
    after = eqx.filter_eval_shape(reset.jump, t, y, args)
    if not are_alike(after, y):
        raise ValueError(
            f"`resets[{i}].jump` must return a state like `y0`, arrays of the shapes {shapes(y)}, got {shapes(after)}."
        )
    for new, old in zip(jtu.tree_leaves(after), jtu.tree_leaves(y), strict=True):
        kind = jnp.result_type(new)
        if jnp.issubdtype(kind, jnp.complexfloating) and not jnp.iscomplexobj(old):
            raise TypeError(
                f"`resets[{i}].jump` must return a state like `y0`, of dtype {jnp.result_type(old)}, got {kind}."
            )


def _depends_on_state(reset: Any, t: FloatScalar, y: Y, args: Args) -> bool:
    """Whether the condition is a function of more than the time and constants."""
    arrays, static = eqx.partition((y, args), eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)

    def condition(t: FloatScalar, *leaves: Any) -> Any:
        y, args = eqx.combine(jtu.tree_unflatten(tree, leaves), static)
        return reset.condition(t, y, args)

    jaxpr = jax.make_jaxpr(condition)(t, *leaves).jaxpr
    used = {id(v) for equation in jaxpr.eqns for v in equation.invars}
    return any(id(v) in used for v in jaxpr.invars[1:])
