"""Measurements on a grid of times: checked, and flat as `(records, times, observed)`."""

from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from .parameters import spread


class Records(NamedTuple):
    """`R` trajectories at `T` times each, `k` numbers observed at every time.

    `weights` is `1 / sigma`, and 0 with `data` 0 where a value is missing. Without `sigma`
    it is one over the root mean square of the data, so that residuals are relative.
    """

    ts: np.ndarray  # (R, T)
    data: np.ndarray  # (R, T, k)
    weights: np.ndarray  # (R, T, k)
    t0: np.ndarray  # (R,)
    many: bool
    absolute: bool  # whether `sigma` was given
    observed: Any  # shapes of one observation


def make_records(
    ts: Any, data: Any, sigma: Any, missing: str | None, t0: Any, observed: Any
) -> Records:
    """Check and flatten the measurements; `observed` has the shapes of one observation."""
    if missing not in (None, "nan"):
        raise ValueError(f"`missing` must be 'nan' or None, got {missing!r}.")
    ts = np.asarray(ts, float)
    many = ts.ndim == 2
    values = flatten(data, ts.shape, observed, "data")
    noise = _flat_sigma(sigma, ts.shape, data, observed)
    if not many:
        ts, values, noise = ts[None], values[None], noise[None]
    t0 = ts[:, 0] if t0 is None else _start_times(t0, ts.shape[0])
    if np.any(t0 > ts[:, 0]):
        raise ValueError(
            f"`t0`, the time of the initial state, must not be after the first of `ts`, "
            f"{ts[:, 0].min()}, got {t0.max()}."
        )
    known = _check_values(values, missing)
    weights = np.where(known, 1 / noise, 0.0)
    values = np.where(known, values, 0.0)
    if sigma is None:
        size = np.sqrt(np.sum(values**2) / np.sum(known))
        weights = weights / (size if size > 0 else 1.0)
    return Records(ts, values, weights, t0, many, sigma is not None, observed)


def _start_times(t0: Any, records: int) -> np.ndarray:
    given = np.asarray(t0)
    if given.dtype.kind not in "iuf" or given.shape not in ((), (records,)):
        raise ValueError(
            f"`t0`, the time of the initial state, must be a real number, or one for each of {records} records, "
            f"got {given.dtype} of shape {given.shape}."
        )
    if not np.all(np.isfinite(given)):
        raise ValueError(f"`t0`, the time of the initial state, must be finite, got {t0}.")
    return np.broadcast_to(given.astype(float), (records,))


def check_times(ts: Any) -> None:
    ts = np.asarray(ts)
    if ts.ndim not in (1, 2) or ts.shape[-1] < 2 or ts.shape[0] == 0:
        raise ValueError(
            "`ts` must have shape (times,) for one trajectory, or (records, times) for many, two times or more "
            f"(repeat a common grid with `jnp.tile(ts, (records, 1))`), got {ts.shape}."
        )
    if not np.all(np.isfinite(ts)) or not np.all(np.diff(ts, axis=-1) > 0):
        raise ValueError(
            "`ts` must be finite and increasing. Sort the measurements by time; where a record "
            'is shorter, go on with later times, data NaN and `missing="nan"`.'
        )


def flatten(data: Any, lead: tuple[int, ...], observed: Any, name: str) -> np.ndarray:
    """Return leaves of shape `lead + s` as one array `lead + (k,)`."""
    if jtu.tree_structure(data) != jtu.tree_structure(observed):
        raise ValueError(
            f"`{name}` must have the structure of what is observed at one time, "
            f"{jtu.tree_structure(observed)}, got {jtu.tree_structure(data)}. Pass "
            "`observe=lambda t, y, parameters: ...` that returns what was measured."
        )
    flat = []
    for leaf, struct in zip(jtu.tree_leaves(data), jtu.tree_leaves(observed), strict=True):
        if np.iscomplexobj(leaf):
            raise ValueError(
                f"`{name}` must be real numbers, got complex ones. Make the real and the imaginary part components: "
                "`jnp.stack([z.real, z.imag], axis=-1)`."
            )
        leaf = np.asarray(leaf, float)
        if leaf.shape != lead + struct.shape:
            raise ValueError(
                f"`{name}` must be on the grid `ts`, i.e. have the shape {lead + struct.shape} "
                "(that of `ts`, then that of one observation, which is the state of `y0` unless you pass `observe`), "
                f"got {leaf.shape}."
            )
        flat.append(leaf.reshape(*lead, -1))
    return np.concatenate(flat, axis=-1)


def _flat_sigma(sigma: Any, lead: tuple[int, ...], data: Any, observed: Any) -> np.ndarray:
    advice = (
        "`sigma` must be a number, or have the structure of `data` with leaves that broadcast to "
        "its shapes."
    )
    full = spread(1.0 if sigma is None else sigma, data, advice)
    flat = flatten(full, lead, observed, "sigma")
    if not np.all(np.isfinite(flat) & (flat > 0)):
        raise ValueError(
            "`sigma` must be positive and finite. Leave a measurement out by NaN in `data` and "
            '`missing="nan"`.'
        )
    return flat


def _check_values(values: np.ndarray, missing: str | None) -> np.ndarray:
    if np.any(np.isinf(values)):
        raise ValueError('`data` has infinite values. Mark them NaN and write `missing="nan"`.')
    known = ~np.isnan(values)
    if missing is None and not np.all(known):
        record, time, _ = np.argwhere(~known)[0]
        raise ValueError(
            f"`data` has {np.sum(~known)} NaN values, the first at time index {time} of record "
            f'{record}. Write `missing="nan"` if they were not measured.'
        )
    empty = np.flatnonzero(~np.any(known, axis=(1, 2)))
    if empty.size:
        raise ValueError(f"`data` of record {empty[0]} has no observed value. Leave it out.")
    return known


def filled_in_time(records: Records) -> np.ndarray:
    """Return the data with missing values interpolated linearly in time, shape `(R, T, k)`."""
    filled = records.data.copy()
    for r, k in np.ndindex(filled.shape[0], filled.shape[2]):
        known = records.weights[r, :, k] > 0
        if not np.any(known):
            raise ValueError(
                f"`data` has nothing on component {k} of record {r}, so that the states at the "
                "`segments` cannot be guessed. Pass guesses in `states`."
            )
        filled[r, :, k] = np.interp(records.ts[r], records.ts[r, known], filled[r, known, k])
    return filled


def unflatten(flat: np.ndarray, observed: Any) -> Any:
    """Invert `flatten`."""
    leaves, structure = jtu.tree_flatten(observed)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = np.split(flat, ends, axis=-1)
    shaped = [
        part.reshape(*flat.shape[:-1], *leaf.shape)
        for part, leaf in zip(parts, leaves, strict=True)
    ]
    return jtu.tree_unflatten(structure, shaped)
