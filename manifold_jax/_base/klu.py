"""The package klujax, if it is installed: SuiteSparse's KLU for JAX (Davis & Palamadai Natarajan, ACM
Trans. Math. Softw. 37 (2010) 36)."""

import functools
import importlib
import importlib.util
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from .device import platform


def has_klu(dtype: Any) -> bool:
    """Whether systems of these numbers can be solved by KLU: on CPUs, in double precision."""
    return (
        importlib.util.find_spec("klujax") is not None
        and platform() == "cpu"
        and jnp.dtype(dtype) == jnp.float64
    )


@functools.cache
def klujax() -> ModuleType:
    """Import klujax without its settings: it switches 64-bit numbers on and accelerators off."""
    names = ("jax_enable_x64", "jax_platform_name")
    before = {name: jax.config.values[name] for name in names}
    try:
        return importlib.import_module("klujax")
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
