"""The settings of a stored ensemble, compared before another run continues it."""

import hashlib
import re
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np


# Packages whose versions may change the rounding.
_PACKAGES = ("manifold_jax", "diffrax", "equinox", "jax", "jaxlib")
_IN_PROGRAM = ("sample", "terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller")


def settings_of(given: dict[str, Any], program: str) -> dict[str, Any]:
    """Return the settings as JSON values. `program` is the traced program before compilation."""
    described = {name: _described(value) for name, value in given.items()}
    device = jax.devices()[0]
    versions = {f"version of {name}": version(name) for name in _PACKAGES}
    return {
        **described,
        "device": f"{device.platform}, {device.device_kind}",
        "x64": bool(jax.config.read("jax_enable_x64")),
        **versions,
        "program": _fingerprint(program, given),
    }


def _described(value: Any) -> Any:
    """Return numbers and strings as they are, anything else as its text without addresses."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    return re.sub(r" at 0x[0-9a-f]+", "", eqx.tree_pformat(value, width=10_000))


def _fingerprint(program: str, inputs: Any) -> str:
    """Return a fingerprint of a program and of its input arrays, those in functions included."""
    digest = hashlib.sha256(program.encode())
    for leaf in jtu.tree_leaves(eqx.filter(inputs, eqx.is_array)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def check_settings(path: Any, stored: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to continue with other settings, and name them."""
    names = [name for name in now | stored if stored.get(name) != now.get(name)]
    if "program" not in names:
        # Then these differ only by the names of functions in their text.
        names = [name for name in names if name not in _IN_PROGRAM]
    if names == ["program"]:
        raise ValueError(
            f"`path={str(path)!r}` was computed from another program: `terms`, the constraint or `sample` differ. Take "
            "another folder, or those functions."
        )
    if names:
        was_and_is = "; ".join(
            f"`{name}` was {stored.get(name)!r} and is {now.get(name)!r}"
            for name in names
            if name != "program"
        )
        raise ValueError(
            f"`path={str(path)!r}` was computed with other settings: {was_and_is}. Take another folder, or those "
            "settings."
        )
