"""The arguments that each trajectory has of its own, and those that are common to all."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array

from ..._base.types import Args, Y
from ..._constraint.checks import check_state
from ..._solve.prepare import time_dtype
from ..._solve.times import is_no_step, NO_FIRST_STEP, NO_OUTPUT_TIME
from .trajectory import end_floor, TrajectoryData


# Names of the axes of a mesh over which trajectories are distributed; none on one device.
Axes = tuple[str, ...]


def largest(x: Array, axes: Axes) -> Array:
    """Return the largest value over all trajectories. All processes get the same one and raise
    together: a process that raised alone would leave the others waiting."""
    return lax.pmax(jnp.max(x), axes) if axes else jnp.max(x)


def anywhere(x: Array, axes: Axes) -> Array:
    return largest(jnp.any(x).astype(jnp.int32), axes) > 0


class Batch(eqx.Module):
    """The fields of [`TrajectoryData`][], split into leaves with the trajectories in front, and common ones."""

    each: Any
    common: Any
    dtype: Any = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def complete(self, each: Any) -> TrajectoryData:
        """Return the arguments of one trajectory, from its part of `each`."""
        given = eqx.combine(each, self.common)
        t0, t1 = jnp.asarray(given.t0, self.dtype), jnp.asarray(given.t1, self.dtype)
        return given._replace(t0=t0, t1=t1)

    def one(self) -> TrajectoryData:
        """Return an example."""
        return self.complete(jtu.tree_map(lambda x: x[0], self.each))


def checked_batch(
    t0: Any, t1: Any, dt0: Any, y0s: Y, args: Args, args_axes: Any, saveat: dfx.SaveAt, lanes: int
) -> Batch:
    """Check the leading axes; errors name the argument."""
    if not isinstance(lanes, int) or lanes < 1:
        raise ValueError(f"`lanes` must be a positive integer, got {lanes!r}.")
    check_state(y0s, "y0s")
    y0s = jtu.tree_map(jnp.asarray, y0s)
    timed = tuple(eqx.is_array(t) and t.ndim > 0 for t in (t0, t1))
    axes = jtu.tree_map(lambda _: True, y0s), _axes(args_axes, args)
    mask = TrajectoryData._make((*timed, *axes, any(timed)))
    own = eqx.filter(TrajectoryData._make((t0, t1, y0s, args, None)), mask)
    parts = {"y0s": own.y0, "t0": own.t0, "t1": own.t1, "args": own.args}
    leaves = [(name, x) for name in parts for x in jtu.tree_leaves_with_path(parts[name])]
    sizes = {f"{name}{jtu.keystr(path)}": _size(x) for name, (path, x) in leaves}
    _check_sizes(sizes)
    start, end = (t if np.ndim(t) == 0 else t[0] for t in (t0, t1))
    dtype = time_dtype(start, end, dt0, saveat)
    floor = end_floor(jnp.asarray(t0, dtype), jnp.asarray(t1, dtype))
    each, common = eqx.partition(TrajectoryData(t0, t1, y0s, args, floor), mask)
    return Batch(each, common, dtype, next(iter(sizes.values())))  # pyright: ignore[reportArgumentType, reportCallIssue]


def checked_step(dt0: Any, batch: Batch, axes: Axes) -> Any:
    """Refuse, while running, a first step that leads away from the end of some trajectory."""
    if dt0 is None:
        return None
    t0, t1 = _ends(batch)
    dt0 = jnp.asarray(dt0, batch.dtype)
    dt0 = eqx.error_if(dt0, is_no_step(dt0), NO_FIRST_STEP)
    message = "`dt0` must have the sign of t1 - t0 in all trajectories; None chooses it for each."
    return eqx.error_if(dt0, anywhere((t1 - t0) * dt0 < 0, axes), message)


def checked_times(saveat: dfx.SaveAt, batch: Batch, axes: Axes) -> dfx.SaveAt:
    """Refuse, while running, times of `SaveAt(ts=...)` that some trajectory does not reach."""

    def checked(sub: dfx.SubSaveAt) -> dfx.SubSaveAt:
        if sub.ts is None:
            return sub
        ts = sub.ts.astype(batch.dtype)
        t0, t1 = _ends(batch)
        direction = jnp.where(t0 < t1, 1, -1).astype(ts.dtype)[:, None]
        ahead = ts[None] * direction
        start, end = t0[:, None] * direction, t1[:, None] * direction
        outside = anywhere((ahead < start) | (ahead > end), axes)
        unsorted = anywhere(ahead[:, 1:] < ahead[:, :-1], axes)
        ts = eqx.error_if(ts, jnp.isnan(ts), NO_OUTPUT_TIME)
        ts = eqx.error_if(ts, unsorted, "`saveat.ts` must be sorted from t0 to t1.")
        ts = eqx.error_if(
            ts, outside, "`saveat.ts` must lie between t0 and t1 of all trajectories."
        )
        return eqx.tree_at(lambda s: s.ts, sub, ts)

    is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
    subs = jtu.tree_map(checked, saveat.subs, is_leaf=is_sub)
    return eqx.tree_at(lambda s: s.subs, saveat, subs, is_leaf=lambda x: x is None)


def _ends(batch: Batch) -> tuple[Array, Array]:
    """Return `t0` and `t1` of each trajectory, or of one if all have the same: XLA takes seconds to
    fold thousands of equal constants at compile time."""
    t0, t1, *_ = batch.common
    if t0 is not None and t1 is not None:
        return jnp.asarray(t0, batch.dtype)[None], jnp.asarray(t1, batch.dtype)[None]
    return jax.vmap(lambda each: batch.complete(each)[:2])(batch.each)


def _size(x: Any) -> int | None:
    return x.shape[0] if eqx.is_array(x) and x.ndim > 0 else None


def _axes(args_axes: Any, args: Args) -> Any:
    """Return for each leaf of `args` whether it has a leading axis of trajectories."""
    for axis in jtu.tree_leaves(args_axes):
        if axis not in (0, None):
            raise ValueError(f"`args_axes` must be 0 or None, or a tree of them, got {axis!r}.")
    own = lambda axis, part: jtu.tree_map(lambda _: axis is not None, part)
    try:
        return jtu.tree_map(own, args_axes, args, is_leaf=lambda x: x is None)
    except ValueError as error:
        raise ValueError(
            "`args_axes` must be 0, None, or a tree of them of the upper structure of `args`."
        ) from error


def _check_sizes(sizes: dict[str, int | None]) -> None:
    for name, size in sizes.items():
        if size is None:
            raise ValueError(
                f"`{name}` is one number, but needs a leading axis, one entry for each trajectory. What is common to "
                "all trajectories is marked by None in `args_axes`, e.g. `args_axes=None`."
            )
    if len(set(sizes.values())) > 1:
        raise ValueError(
            f"Leading axes are the trajectories and must be equally long, got {sizes}. What is common to all "
            "trajectories is marked by None in `args_axes`, what each has of its own by 0."
        )
    if 0 in sizes.values():
        raise ValueError("`y0s` has no trajectories: its leading axis is empty.")
