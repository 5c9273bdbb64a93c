"""Evaluations of a vector field and of a constraint, counted as a compiled solve makes them."""

import collections
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.custom_derivatives import SymbolicZero

import manifold_jax as mj
from manifold_jax._mechanics import MechanicalConstraint
from manifold_jax._tools.compare.approaches import Formulation, with_vector_field
from manifold_jax.problems import Problem


class Evaluations(NamedTuple):
    """How often each function was evaluated in a solve, rejected steps included.

    - `f`: the vector field. What it evaluates of the constraint itself is not counted.
    - `g`: the residual of the constraint; of the positions alone in mechanics.
    - `velocity`: in mechanics the residual of the velocities, `dg/dt` along the motion.
    - `G`: the Jacobian of the residual, the residual at the same point included.
    """

    f: float
    g: float
    velocity: float
    G: float


class Counter:
    """Counts; a solve calls back, so that it has to be done (`jax.effects_barrier`) first."""

    def __init__(self):
        self._counts: collections.Counter[str] = collections.Counter()

    def reset(self) -> None:
        self._counts.clear()

    def evaluations(self) -> Evaluations:
        return Evaluations(**{name: self._counts[name] for name in Evaluations._fields})

    def tick(self, name: str) -> None:
        """To be traced: one evaluation."""
        jax.debug.callback(functools.partial(self._add, name))

    def _add(self, name: str) -> None:
        self._counts[name] += 1

    def with_counted_constraint(self, problem: Problem) -> Problem:
        """The problem with a constraint that is counted; its terms use the original one."""
        constraint = problem.constraint
        if not isinstance(constraint, MechanicalConstraint):
            counted = mj.Constraint(self._residual(constraint))
        elif constraint.holonomic is not None:
            residual = self._residual(constraint.holonomic)
            counted = eqx.tree_at(lambda c: c.holonomic, constraint, residual)
        else:
            residual = self._residual(constraint.nonholonomic)
            counted = eqx.tree_at(lambda c: c.nonholonomic, constraint, residual)
        return eqx.tree_at(lambda p: p.constraint, problem, counted)

    def with_counted_field(self, formulation: Formulation) -> Formulation:
        def counting(field: Callable) -> Callable:
            def counted(t: Any, y: Any, args: Any) -> Any:
                self.tick("f")
                return field(t, y, args)

            return counted

        return formulation._replace(terms=with_vector_field(formulation.terms, counting))

    def _residual(self, residual: Any) -> Callable:
        """`residual(t, ...)`, whose derivatives are counted apart.

        A derivative in which the time moves, too, is one along the motion.
        """

        @jax.custom_jvp
        def counted(*arguments: Any) -> Any:
            self.tick("g")
            return residual(*arguments)

        def derivative(primals: Any, tangents: Any) -> Any:
            self.tick("G" if isinstance(tangents[0], SymbolicZero) else "velocity")
            tangents = jtu.tree_map(_instantiated, primals, tangents)
            return jax.jvp(residual, primals, tangents)

        counted.defjvp(derivative, symbolic_zeros=True)
        return counted


def _instantiated(primal: Any, tangent: Any) -> Any:
    return jnp.zeros_like(primal) if isinstance(tangent, SymbolicZero) else tangent
