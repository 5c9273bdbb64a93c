"""Predator and prey (Lotka-Volterra) with its first integral."""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import FloatScalar, RealScalarLike
from ._problem import Problem, require_standard


class LotkaVolterraArgs(NamedTuple):
    """Parameters of `lotka_volterra`, the rates `p0, p1, p2, p3` in this order."""

    prey_birth: Any = 1.5
    prey_loss: Any = 1.0
    predator_death: Any = 3.0
    predator_gain: Any = 1.0


# The state at t = 10 for the standard parameters from (1, 1), as printed by the SUNDIALS
# example ark_lotka_volterra_ASA (fixed steps of 1e-3): 11 digits are right.
PUBLISHED_END = (1.026344767571517, 9.096910781383605e-1)
# The same to 16 digits: Taylor series of order 30, step 0.1, in 40-digit arithmetic.
END = (1.02634476757508932, 0.909691078136041618)
# Derivatives of `|1 - y(10)|^2 / 2` with respect to the initial state and the rates, in the same way.
COST_BY_START = (0.299599508303682302, -0.0141518163448535055)
COST_BY_RATES = (
    0.621961585551280884, 0.0680014041508743366, 0.169176463995892817, 0.272560693950007505,
)  # fmt: skip


def _field(t: RealScalarLike, y: Float[Array, "2"], args: LotkaVolterraArgs) -> Float[Array, "2"]:
    p0, p1, p2, p3 = args
    prey, predator = y[0], y[1]
    meetings = prey * predator
    return jnp.stack([p0 * prey - p1 * meetings, p3 * meetings - p2 * predator])


def _invariant(t: RealScalarLike, y: Float[Array, "2"], args: LotkaVolterraArgs) -> FloatScalar:
    p0, p1, p2, p3 = args
    prey, predator = y[0], y[1]
    return p3 * prey - p2 * jnp.log(prey) + p1 * predator - p0 * jnp.log(predator)


def _initial_state(args: LotkaVolterraArgs, start: Float[Array, "2"] | None) -> Float[Array, "2"]:
    return jnp.ones(2, jnp.result_type(*args)) if start is None else start


def _exact(t: np.ndarray, args: LotkaVolterraArgs, y0: np.ndarray) -> np.ndarray:
    require_standard("lotka-volterra", (LotkaVolterraArgs(), np.ones(2)), (args, y0))
    return np.tile(np.array(END), (t.size, 1))


def lotka_volterra(
    *,
    prey_birth: Any = 1.5,
    prey_loss: Any = 1.0,
    predator_death: Any = 3.0,
    predator_gain: Any = 1.0,
) -> Problem:
    r"""Predator $y$ and prey $x$ with their first integral:

    $$x' = p_0 x - p_1 x y, \quad y' = p_3 x y - p_2 y, \quad
    V = p_3 x - p_2 \log x + p_1 y - p_0 \log y = \text{const}.$$

    The state is `(x, y)` as one array of shape `(2,)`, positive; one constraint; from `(1, 1)` at
    `t = 0` to `t = 10`. The state at the end alone is known (`reference_at_end_only`), for the standard
    parameters and initial state: 11 digits are published, `reference` gives 16.

    **Arguments:**

    - `prey_birth`, `prey_loss`, `predator_death`, `predator_gain`: the rates $p_0$ to
        $p_3$, `args`. `with_args` keeps the initial state.

    A known trap: the gradients that the same source prints for `|1 - y(10)|^2 / 2` are
    good to 2-3 digits only, as its adjoint run starts at `t = 10.001` from the state at
    `t = 10`. They are 0.2995995 and -0.0141518 for the initial state, 0.6219616, 0.0680014,
    0.1691765 and 0.2725607 for the rates.

    Source: SUNDIALS, example `ark_lotka_volterra_ASA`.
    """
    return Problem(
        "lotka-volterra",
        diffrax.ODETerm(_field),
        t1=10.0,
        args=LotkaVolterraArgs(prey_birth, prey_loss, predator_death, predator_gain),
        initial_state=_initial_state,
        invariants=_invariant,
        exact=_exact,
        reference_at_end_only=True,
    )
