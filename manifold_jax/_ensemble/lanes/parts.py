"""What an ensemble is solved from, by what has derivatives."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu

from ..._solve.setup import Given
from .arguments import Batch
from .trajectory import Equations


Inputs = tuple[Equations, Batch]


class Parts(NamedTuple):
    """Differentiated are `each`, the trajectories in front, and `common`; `rest_each` and `rest`
    are what is left."""

    each: Any
    common: Any
    rest_each: Any
    rest: Any

    @staticmethod
    def of(inputs: Inputs, differentiated: Any) -> "Parts":
        """`differentiated`: a tree of truth values."""
        smooth, rest = eqx.partition(inputs, differentiated)
        without = lambda x: (x[0], dataclasses.replace(x[1], each=None))
        return Parts(smooth[1].each, without(smooth), rest[1].each, without(rest))

    def one(self, each: Any, common: Any, rest_each: Any) -> tuple[Equations, Given]:
        """A trajectory and what it is solved by."""
        equations, batch = eqx.combine(common, self.rest)
        return in_steps(equations), batch.complete(eqx.combine(each, rest_each))

    def inputs(self, each: Any, common: Any) -> Inputs:
        equations, batch = eqx.combine(common, self.rest)
        return equations, dataclasses.replace(batch, each=eqx.combine(each, self.rest_each))

    def together(self, each: Any, common: Any) -> Inputs:
        """Return a tree of the structure of the inputs, without what is not differentiated."""
        equations, batch = common
        return equations, dataclasses.replace(batch, each=each)

    def num_common(self) -> int:
        return sum(x.size for x in jtu.tree_leaves(self.common))


def in_steps(equations: Equations) -> Equations:
    """Return the equations with the solver as it is in the loop over steps."""
    solver = equations.solver.within(equations.controller, bends_interpolant=False)
    return dataclasses.replace(equations, solver=solver)


def times_are_differentiated(differentiated: Any) -> bool:
    """Whether any of the times, step sizes or tolerances is."""
    equations, batch = differentiated
    timed = (
        batch.each[:2],
        batch.common[:2],
        equations.dt0,
        equations.controller,
        [sub.ts for sub in jtu.tree_leaves(equations.saveat.subs, is_leaf=_is_sub)],
    )
    return any(x is True for x in jax.tree.leaves(timed))


def _is_sub(x: Any) -> bool:
    return hasattr(x, "ts")
