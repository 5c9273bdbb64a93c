"""How long a traced function is: what it costs to write it out once more."""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jax_core


def num_equations(function: Callable[..., Any], *examples: Any) -> int:
    """Of the function traced, inner functions included."""
    return _length(jax.make_jaxpr(function)(*examples).jaxpr)


def _length(jaxpr: Any) -> int:
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for inner in jax_core.jaxprs_in_params(equation.params):
            total += _length(inner)
    return total
