"""The inputs of an ensemble, divided into a differentiated part and the rest."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax

from ..._adjoint.replay import subs_of
from .arguments import Batch
from .trajectory import LaneEquations, TrajectoryData


class Inputs(NamedTuple):
    """The data that all trajectories have in common, and those that each has of its own."""

    equations: LaneEquations
    batch: Batch

    def with_solver(self, solver: Any) -> "Inputs":
        return self._replace(equations=dataclasses.replace(self.equations, solver=solver))


class Parts(NamedTuple):
    """The inputs in four parts. `each` (with the trajectories in front) and `common` are
    differentiated, `rest_each` and `rest` are not."""

    each: Any
    common: Any
    rest_each: Any
    rest: Any

    @staticmethod
    def of(inputs: Inputs, differentiated: Any) -> "Parts":
        """Divide the inputs; `differentiated` is a tree of Booleans."""
        smooth, rest = eqx.partition(inputs, differentiated)
        without = lambda x: x._replace(batch=dataclasses.replace(x.batch, each=None))
        return Parts(smooth.batch.each, without(smooth), rest.batch.each, without(rest))

    def one(self, each: Any, common: Any, rest_each: Any) -> tuple[LaneEquations, TrajectoryData]:
        """Return the equations, and the data of one trajectory."""
        equations, batch = eqx.combine(common, self.rest)
        return in_steps(equations), batch.complete(eqx.combine(each, rest_each))

    def smooth(self, function: Callable, rest_each: Any, *args: Any) -> Callable:
        """Return `function(equations, given, x, *args)` as a function of what it is differentiated with
        respect to: `each`, `common` and `x`."""
        return lambda each, common, x: function(*self.one(each, common, rest_each), x, *args)

    def inputs(self, each: Any, common: Any) -> Inputs:
        equations, batch = eqx.combine(common, self.rest)
        return Inputs(equations, dataclasses.replace(batch, each=eqx.combine(each, self.rest_each)))


def in_steps(equations: LaneEquations) -> LaneEquations:
    """Return the equations with the solver as it is in the loop over steps."""
    solver = equations.solver.within(equations.controller, bends_interpolant=False)
    return dataclasses.replace(equations, solver=solver)


def times_are_differentiated(differentiated: Any) -> bool:
    """Whether any of the times, step sizes or tolerances is differentiated."""
    equations, batch = differentiated
    subs = subs_of(equations.saveat)
    timed = batch.each[:2], batch.common[:2], equations.dt0, equations.controller
    return any(x is True for x in jax.tree.leaves((timed, [sub.ts for sub in subs])))
