"""Impacts of mechanical systems: jumps of the velocities when a gap closes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp

from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._resets.reset import Reset
from .motion import EquationsOfMotion
from .system import MechanicalSystem


def impact(
    system: MechanicalSystem,
    gap: Callable[[RealScalarLike, Y, Args], Any],
    restitution: RealScalarLike | Callable[[Args], Any],
    *,
    samples: int = 10,
    max_number: int | None = None,
) -> Reset:
    r"""The reset of a mechanical system when a gap closes: an impact without friction.

    With the normal $n = \partial gap / \partial q$ and the rate $\dot g = n \cdot v + \partial gap / \partial t$
    the velocities after the impact are those of one linear system with all constraints,

    $$M (v^+ - v^-) = J^T \Lambda + n^T p, \qquad J v^+ = J v^-, \qquad \dot g^+ = -e\, \dot g^-,$$

    so that the constraints hold and transmit their own impulses $\Lambda$. The positions and auxiliary
    states are unchanged. For a single contact without friction Newton's law (of velocities, above) and
    Poisson's (of impulses, $p = (1 + e) p_c$ with $p_c$ that of $e = 0$) are the same.

    ```python
    stop = mj.impact(system, gap=lambda t, q, args: 1.2 - q[1], restitution=0.6)
    hook = mj.Projected(dfx.Tsit5(), system.constraint)
    sol = mj.diffeqsolve(system.terms, hook, 0.0, 1.0, None, y0, ..., resets=(stop,))
    ```

    **Arguments:**

    - `system`: the mechanical system that is solved.
    - `gap`: `gap(t, q, args)`, a real number that is positive where there is no contact.
    - `restitution`: `e` between 0 (plastic) and 1 (elastic), a number or a function of `args`. After a
        plastic impact the gap stays closed: write a constraint that a [`Reset`][] switches on instead, as the page
        on resets does.
    - `samples`, `max_number`: as for [`Reset`][].

    **Returns:**

    A [`Reset`][]. The solve fails at an impact whose normal is a combination of the constraints', as
    they would have to give way, and where a function `restitution` returns no number between 0 and 1.

    **Raises:**

    `ValueError` for a `restitution` that is not between 0 and 1, `TypeError` for a `gap` that is not a
    function of that form.

    Source: Brogliato, Nonsmooth Mechanics (2016), ch. 4 (generalized impacts, kinetic metric).
    """
    if not isinstance(system, MechanicalSystem):
        raise TypeError(
            f"`system` must be an `mj.MechanicalSystem`, got {type(system).__name__}. For other equations write the jump "
            "itself, `mj.Reset(condition, jump)`."
        )
    check_function("gap", gap, "gap(t, q, args)")
    if callable(restitution):
        check_function("restitution", restitution, "restitution(args)")
    elif not isinstance(restitution, jax.core.Tracer) and not 0 <= restitution <= 1:
        raise ValueError(f"`restitution` must be between 0 and 1, got {restitution}.")

    def jump(t: RealScalarLike, y: Y, args: Args) -> Y:
        value = restitution(args) if callable(restitution) else restitution
        return _after_impact(system, gap, value, t, y, args)

    return Reset(
        lambda t, y, args: gap(t, y[0], args),
        jump,
        direction=False,
        samples=samples,
        max_number=max_number,
    )


def _after_impact(
    system: MechanicalSystem,
    gap: Callable,
    restitution: Any,
    t: RealScalarLike,
    y: Y,
    args: Args,
) -> Y:
    q = y[0]

    def positions(t: RealScalarLike, q: Y, args: Args) -> Any:
        own = () if system.holonomic is None else system.holonomic(t, q, args)
        return own, gap(t, q, args)

    # The gap is the last of the constraints on positions.
    closed = MechanicalSystem(
        system.mass_matrix,
        positions,
        system.force,
        velocity_constraint=system.nonholonomic,
        auxiliary=system.auxiliary,
        auxiliary_constraint=system.auxiliary_constraint,
        redundant=system.redundant,
        structure="dense",
    )
    motion = EquationsOfMotion(closed, t, y, args)
    row = motion.num_positions - 1
    rates = motion.here.velocities()
    e = jnp.asarray(restitution, rates.dtype)
    wanted = jnp.zeros_like(rates).at[row].set(-(1 + e) * rates[row])
    change = motion.constrained(wanted)
    velocity = motion.unravel(motion.here.w + change)
    after = motion.here.velocity(motion.here.t, motion.here.w + change, (motion.here.x, args))
    # Impacts without end become slower than rounding.
    rounding = (
        1e3 * jnp.finfo(rates.dtype).eps * jnp.max(jnp.abs(motion.C) @ jnp.abs(motion.here.w))
    )
    held = jnp.max(jnp.abs(after - rates - wanted)) <= 1e-6 * jnp.abs(rates[row]) + rounding
    possible = held & (e >= 0) & (e <= 1) & motion.mass.valid
    # Added, not selected: the derivative of a discarded NaN would be NaN.
    undefined = jnp.where(possible, 0, jnp.nan)
    velocity = jax.tree_util.tree_map(lambda x: x + undefined.astype(x.dtype), velocity)
    return q, velocity, *y[2:]
