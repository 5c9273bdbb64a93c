"""The values of primitives of JAX for known operands.

By NumPy wherever it gives the same numbers: JAX compiles a program for each operation and shape, which takes
longer than all the rest of reading a vector field.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np


def evaluated(primitive: Any, params: dict, operands: Sequence[Any]) -> list[np.ndarray]:
    """Return the results for known operands."""
    name = primitive.name
    if name in _MOVED:
        return [np.asarray(x) for x in _MOVED[name](params, *operands)]
    if _is_exact(name, params, operands):
        with np.errstate(all="ignore"):
            if name == "convert_element_type":
                return [np.asarray(operands[0]).astype(params["new_dtype"])]
            if name in _COMPUTED:
                return [np.asarray(_COMPUTED[name](*operands))]
    with jax.ensure_compile_time_eval():
        out = primitive.bind(*operands, **unsharded(params))
    return [np.asarray(x) for x in (out if primitive.multiple_results else [out])]


def unsharded(params: dict) -> dict:
    """Return the parameters of the primitive for arrays of a single device."""
    return {**params, "sharding": None} if "sharding" in params else params


def _is_exact(name: str, params: dict, operands: Sequence[Any]) -> bool:
    """Return whether NumPy does the same: not where integers are divided, or made of other numbers, and not
    with complex numbers (other roundings) or types that it does not know itself, such as `bfloat16`."""
    kinds = [np.asarray(x).dtype.kind for x in operands]
    if not set(kinds) <= set("biuf"):
        return False
    if name == "div":
        return kinds[0] == "f"
    if name == "convert_element_type":
        new = np.dtype(params["new_dtype"]).kind
        return new == "f" or (kinds[0] in "biu" and new in "biu")
    if name == "select_n":
        return len(operands) == 3
    return True


def _slice(parameters: dict, x: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, parameters["start_indices"], parameters["limit_indices"], strides))]


def _reshape(parameters: dict, x: np.ndarray) -> np.ndarray:
    order = parameters["dimensions"]  # in which the axes are read
    return (x if order is None else x.transpose(order)).reshape(parameters["new_sizes"])


def _broadcast(parameters: dict, x: np.ndarray) -> np.ndarray:
    shape, own = parameters["shape"], parameters["broadcast_dimensions"]
    new = tuple(axis for axis in range(len(shape)) if axis not in own)
    return np.broadcast_to(np.expand_dims(x, new), shape)


def _pad(parameters: dict, x: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Put numbers of `value` before, after and between those of `x`; negative widths cut off."""
    config = parameters["padding_config"]
    sizes = [
        n + max(n - 1, 0) * between for n, (_, _, between) in zip(x.shape, config, strict=True)
    ]
    widths = [(max(before, 0), max(after, 0)) for before, after, _ in config]
    pairs = list(zip(sizes, widths, strict=True))
    out = np.full([before + n + after for n, (before, after) in pairs], value, x.dtype)
    steps = [between + 1 for *_, between in config]
    own = [
        slice(before, before + n, step) for (n, (before, _)), step in zip(pairs, steps, strict=True)
    ]
    out[tuple(own)] = x
    kept = [
        slice(max(-before, 0), n + min(after, 0))
        for n, (before, after, _) in zip(out.shape, config, strict=True)
    ]
    return out[tuple(kept)]


def _iota(parameters: dict) -> np.ndarray:
    shape, axis = parameters["shape"], parameters["dimension"]
    along = np.arange(shape[axis]).astype(parameters["dtype"])
    return np.broadcast_to(
        np.expand_dims(along, [*range(axis), *range(axis + 1, len(shape))]), shape
    )


def _split(parameters: dict, x: np.ndarray) -> list[np.ndarray]:
    return np.split(x, np.cumsum(parameters["sizes"])[:-1], parameters["axis"])


def _unstack(parameters: dict, x: np.ndarray) -> list[np.ndarray]:
    return list(map(np.asarray, np.moveaxis(x, parameters["axis"], 0)))


def _alone(function: Callable) -> Callable:
    return lambda *operands: [function(*operands)]


_MOVED: dict[str, Callable[..., list[np.ndarray]]] = {
    "broadcast_in_dim": _alone(_broadcast),
    "concatenate": lambda parameters, *xs: [np.concatenate(xs, parameters["dimension"])],
    "copy": lambda parameters, x: [x],
    "copy_p": lambda parameters, x: [x],
    "iota": _alone(_iota),
    "pad": _alone(_pad),
    "reshape": _alone(_reshape),
    "rev": lambda parameters, x: [np.flip(x, parameters["dimensions"])],
    "slice": _alone(_slice),
    "split": _split,
    "squeeze": lambda parameters, x: [np.squeeze(x, tuple(parameters["dimensions"]))],
    "stack": lambda parameters, *xs: [np.stack(xs, parameters["axis"])],
    "transpose": lambda parameters, x: [x.transpose(parameters["permutation"])],
    "unstack": _unstack,
}
_COMPUTED: dict[str, Callable[..., np.ndarray]] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "div": np.divide,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "lt": np.less,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "select_n": lambda which, no, yes: np.where(which, yes, no),
    "sqrt": np.sqrt,
    "square": np.square,
    "sub": np.subtract,
}
