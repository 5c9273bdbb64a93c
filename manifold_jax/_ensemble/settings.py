"""What a stored ensemble was computed with, to refuse another that would be mixed into it."""

import hashlib
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np


# Of which another version may round otherwise.
_PACKAGES = ("manifold_jax", "diffrax", "equinox", "jax", "jaxlib")


def described(value: Any) -> Any:
    """As JSON has it: numbers and words as they are, of anything else how it is written."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    return eqx.tree_pformat(value, width=10_000)


def environment() -> dict[str, Any]:
    device = jax.devices()[0]
    return {
        "device": f"{device.platform}, {device.device_kind}",
        "x64": bool(jax.config.read("jax_enable_x64")),
        **{f"version of {name}": version(name) for name in _PACKAGES},
    }


def fingerprint(program: str, inputs: Any) -> str:
    """Of a program before it is compiled, and of the arrays it is called with: of functions, too."""
    digest = hashlib.sha256(program.encode())
    for leaf in jtu.tree_leaves(eqx.filter(inputs, eqx.is_array)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def check_settings(path: Any, stored: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with other settings, and say which."""
    names = [name for name in now | stored if stored.get(name) != now.get(name)]
    if names == ["program"]:
        raise ValueError(
            f"`out={str(path)!r}` was computed from another program: `terms`, the constraint or `sample` differ. Take "
            "another folder, or those functions."
        )
    if names:
        differ = "; ".join(
            f"`{name}` was {stored.get(name)!r} and is {now.get(name)!r}"
            for name in names
            if name != "program"
        )
        raise ValueError(
            f"`out={str(path)!r}` was computed with other settings: {differ}. Take another folder, or those settings."
        )
