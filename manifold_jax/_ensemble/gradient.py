"""Cotangents of what an ensemble is solved from, by the way back in lanes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._scalar import NotScalarError
from .parts import Inputs, Parts
from .reverse import Ends, WayBack
from .rows import saved_rows
from .schedule import Run


# Numbers that all trajectories have in common, each of which has a sum of its own in every lane.
_MOST_IN_COMMON = 200


def gradient_in_lanes(
    inputs: Inputs, differentiated: Any, run: Run, bar: Any, lanes: int, limit: int
) -> Any:
    """`bar`: cotangents of times and values; `differentiated`: a tree of truth values."""
    parts = Parts.of(inputs, differentiated)
    if parts.num_common() > _MOST_IN_COMMON:
        raise NotScalarError("too many numbers in common")

    smooth_values, others = eqx.partition(run.values, eqx.is_inexact_array)

    def saved(each: Any, common: Any, first: Any, last: Any, smooth_values: Any) -> Any:
        equations, batch = parts.inputs(each, common)
        values = eqx.combine(smooth_values, others)
        start = run.start._replace(trajectory=run.start.trajectory._replace(y=first))
        outcome = run.outcome._replace(y=last)
        new = run._replace(start=start, outcome=outcome, values=values)
        return eqx.filter(saved_rows(equations.saveat.subs, batch, new), eqx.is_inexact_array)

    handed_out = run.start.trajectory.y, run.outcome.y, smooth_values
    rows, pullback = jax.vjp(saved, parts.each, parts.common, *handed_out)
    bar = jtu.tree_map(lambda x, b: jnp.zeros_like(x) if b is None else b, rows, bar)
    each, common, *bars = pullback(bar)
    ends = Ends(run.start.trajectory, run.outcome.num_steps, run.rows, run.states, *bars)
    more = WayBack(parts, ends, lanes, limit).run()
    each, common = jtu.tree_map(jnp.add, (each, common), more)
    return parts.together(each, common)
