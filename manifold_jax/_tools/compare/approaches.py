"""The approaches to a manifold: each turns a problem into terms and a solver for Diffrax."""

import dataclasses
import functools
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx

from ..._constraint.settings import NewtonProjection
from ..._mechanics import Baumgarte
from ..._solve import diffeqsolve
from ..._solver import LocalCoordinates, Projected, Stabilized
from ..._solver.chart import CoordinatePartitionChart, TangentSpaceChart
from ..._solver.stabilization import ExactStabilization, InvariantStabilization
from ...problems import Problem


class Formulation(NamedTuple):
    """A problem as it is integrated: the function that solves, its first two arguments, and the jumps."""

    function: Callable[..., dfx.Solution]
    terms: dfx.AbstractTerm
    solver: dfx.AbstractSolver
    resets: tuple = ()

    def solve(self, t0: Any, t1: Any, y0: Any, args: Any, **options: Any) -> dfx.Solution:
        """Return the solution, with further options of `diffrax.diffeqsolve`; its `result` says whether
        the solve failed."""
        if self.resets:
            options |= {"resets": self.resets}
        return self.function(
            self.terms, self.solver, t0, t1, None, y0, args, throw=False, **options
        )


Formulate = Callable[[Problem, dfx.AbstractSolver, float], Formulation]


class Need(NamedTuple):
    """A requirement that not every problem meets, and its name."""

    is_met_by: Callable[[Problem], bool]
    phrase: str

    def __str__(self) -> str:
        return f"needs {self.phrase}"


SYSTEM = Need(
    lambda problem: problem.system is not None and not problem.resets,
    "a mechanical system without jumps",
)
CHART = Need(lambda problem: problem.chart is not None, "a chart of its own")
CONTINUOUS = Need(lambda problem: not problem.resets, "a solution without jumps")


class Style(NamedTuple):
    """The style of a curve: colour-blind safe (Okabe & Ito), related approaches share a hue."""

    colour: str
    line: str = "solid"


@dataclasses.dataclass(frozen=True)
class Approach:
    """One way to keep a solution on (or near) a manifold, for tables, pictures, certificates and
    benchmarks.

    - `name`: on the command line and in tables.
    - `formulate`: of a problem, a Diffrax solver and a gain (1/time, for stabilization).
    - `style`: in pictures.
    - `needs`: a requirement on the problem, `None` if it is for all.
    - `uses_gain`: whether the gain matters.

    Those of other packages are found by the entry point group `manifold_jax.approaches`, each a
    module-level `Approach`.
    """

    name: str
    formulate: Formulate
    style: Style
    needs: Need | None = None
    uses_gain: bool = False


def default_gain(problem: Problem) -> float:
    """Return the gain with which violations decay by `exp(-30)` in the time span of the problem.

    Measured on seven problems of the gallery (Tsit5, tolerances 1e-4 to 1e-8): ten times that gain
    takes up to 6 times as many steps, for violations at most 4 times smaller.
    """
    return 30 / (problem.t1 - problem.t0)


def _plain(problem: Problem, solver: dfx.AbstractSolver, gain: float) -> Formulation:
    return Formulation(dfx.diffeqsolve, problem.terms, solver)


def _within(
    hook: Callable, options: Callable[[Problem, float], dict[str, Any]] = lambda problem, gain: {}
) -> Formulate:
    """Use the solver in a step hook of this library, with `options(problem, gain)`."""

    def formulate(problem: Problem, solver: dfx.AbstractSolver, gain: float) -> Formulation:
        wrapped = hook(solver, problem.constraint, **options(problem, gain))
        return Formulation(diffeqsolve, problem.terms, wrapped, problem.resets)

    return formulate


_projected = _within(Projected)
_one_step = _within(Projected, lambda problem, gain: {"projection": NewtonProjection(max_steps=1)})
_invariant = _within(
    Stabilized, lambda problem, gain: {"stabilization": InvariantStabilization(gain)}
)
_exact = _within(Stabilized, lambda problem, gain: {"stabilization": ExactStabilization(gain)})
_tangent = _within(LocalCoordinates, lambda problem, gain: {"chart": TangentSpaceChart()})
_partition = _within(LocalCoordinates, lambda problem, gain: {"chart": CoordinatePartitionChart()})
_lie_group = _within(LocalCoordinates, lambda problem, gain: {"chart": problem.chart})


def _baumgarte(problem: Problem, solver: dfx.AbstractSolver, gain: float) -> Formulation:
    """Stabilize with critical damping."""
    assert problem.system is not None
    system = eqx.tree_at(
        lambda s: s.stabilization,
        problem.system,
        Baumgarte(gain, gain),
        is_leaf=lambda x: x is None,
    )
    return Formulation(dfx.diffeqsolve, system.terms, solver)


def _of_other_packages() -> tuple[Approach, ...]:
    found = entry_points(group="manifold_jax.approaches")
    return tuple(point.load() for point in sorted(found, key=lambda point: point.name))


# In the order of the tables.
_OWN: tuple[Approach, ...] = (
    Approach("plain", _plain, Style("#D55E00"), needs=CONTINUOUS),
    Approach("projected", _projected, Style("#0072B2")),
    Approach("one-step", _one_step, Style("#56B4E9", "dashed")),
    Approach("invariant", _invariant, Style("#009E73"), uses_gain=True),
    Approach("exact", _exact, Style("#009E73", "dashed"), uses_gain=True),
    Approach("baumgarte", _baumgarte, Style("#E69F00"), needs=SYSTEM, uses_gain=True),
    Approach("tangent", _tangent, Style("#CC79A7")),
    Approach("partition", _partition, Style("#CC79A7", "dashed")),
    Approach("lie-group", _lie_group, Style("#CC79A7", "dotted"), needs=CHART),
)


@functools.cache
def known_approaches() -> tuple[Approach, ...]:
    """Return the approaches of this library and of other packages; a function, as these import this module."""
    return (*_OWN, *_of_other_packages())


def with_vector_field(terms: Any, wrap: Callable[[Callable], Callable]) -> Any:
    """Return the same terms with `wrap(f)` in place of their vector field `f(t, y, args)`."""
    return eqx.tree_at(lambda term: term.vector_field, terms, wrap(terms.vector_field))
