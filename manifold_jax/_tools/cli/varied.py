"""Problems of the gallery with some of their numbers drawn at random."""

import dataclasses
import math
import re
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import typer
from jaxtyping import Array

from ..._constraint.constraint import AbstractConstraint
from ..._resets.reset import Reset, ResetAt
from ...problems import Problem
from .arguments import check_name


class Distribution(NamedTuple):
    """The distribution of one number: its name, the kind, and the two numbers that describe it."""

    target: str
    kind: str
    a: float
    b: float

    def draw(self, key: Array, dtype: Any) -> Array:
        if self.kind == "normal":
            return self.a + self.b * jax.random.normal(key, dtype=dtype)
        if self.kind == "uniform":
            return jax.random.uniform(key, dtype=dtype, minval=self.a, maxval=self.b)
        a, b = math.log(self.a), math.log(self.b)
        return jnp.exp(jax.random.uniform(key, dtype=dtype, minval=a, maxval=b))

    def __str__(self) -> str:
        return f"{self.target}={self.kind}({self.a}, {self.b})"


# Conditions on the two numbers of each kind.
_KINDS = {
    "uniform": ("uniform(low, high) needs low < high", lambda a, b: a < b),
    "normal": ("normal(mean, std) needs std > 0", lambda a, b: b > 0),
    "loguniform": ("loguniform(low, high) needs 0 < low < high", lambda a, b: 0 < a < b),
}
_HINT = "--vary"


def distributions(texts: list[str], problem: Problem) -> list[Distribution]:
    """Read distributions from `NAME=KIND(A,B)`, or raise an error that lists the valid ones."""
    known = [*_names_in("args", problem.args), *_names_in("y0", problem.y0)]
    out: list[Distribution] = []
    for text in texts:
        match = re.fullmatch(r"\s*([\w.]+)\s*=\s*(\w+)\s*\(([^,()]+),([^,()]+)\)\s*", text)
        if match is None:
            example = f"{known[0]}=uniform(0.5,2)"
            raise typer.BadParameter(f"{text!r} is not of the form {example!r}.", param_hint=_HINT)
        target, kind = match[1], match[2].lower()
        check_name(target, known, f"number of `{problem.name}`", _HINT)
        check_name(kind, _KINDS, "distribution", _HINT)
        if any(target == before.target for before in out):
            raise typer.BadParameter(f"{target!r} is varied twice.", param_hint=_HINT)
        out.append(Distribution(target, kind, *_numbers(text, kind, match[3], match[4])))
        _check_positive(out[-1], text)
    return out


# Parts of the names of positive numbers: with a negative mass there is a solution, but no mechanism.
_POSITIVE = ("length", "mass", "inertia", "radius")


def _check_positive(one: Distribution, text: str) -> None:
    name = next((word for word in _POSITIVE if word in one.target), None)
    if one.kind == "uniform" and name is not None and one.target.startswith("args") and one.a <= 0:
        raise typer.BadParameter(
            f"{text!r} draws values that are not positive, but `{one.target}` is a {name}. Write "
            f"`{one.target}=uniform(LOW, HIGH)` with 0 < LOW, or `loguniform`.",
            param_hint=_HINT,
        )


def _numbers(text: str, kind: str, *words: str) -> tuple[float, float]:
    needs, is_met = _KINDS[kind]
    try:
        a, b = (float(word) for word in words)
    except ValueError:
        a = b = math.nan
    if not (math.isfinite(a) and math.isfinite(b) and is_met(a, b)):
        raise typer.BadParameter(f"{needs}, got {text!r}.", param_hint=_HINT)
    return a, b


class DrawnArgs(NamedTuple):
    """The data that one trajectory has of its own besides its start: parameters, the arrays of its
    constraint (values of invariants) and the drawn numbers, by name."""

    args: Any
    constraint: Any
    drawn: dict[str, Array]


class VariedProblem:
    """Trajectories of a problem with numbers drawn from distributions: initial state and constraint
    are rebuilt for the parameters of each, then components of its initial state are set."""

    def __init__(self, problem: Problem, varied: list[Distribution]):
        self.problem, self.varied = problem, varied
        self.terms = dfx.ODETerm(lambda t, y, given: problem.terms.vf(t, y, given.args))
        self.constraint = ConstraintInArgs(
            template=problem.constraint, redundant=problem.constraint.redundant
        )
        self.resets = tuple(_for_drawn_args(reset) for reset in problem.resets)

    def __repr__(self) -> str:
        """Show the problem as the settings of the folder have it."""
        return f"{self.problem.name} with {', '.join(map(str, self.varied))}"

    def sample(self, index: Array, key: Array) -> tuple[Any, DrawnArgs]:
        problem = self.problem
        dtype = jfu.ravel_pytree((problem.args, problem.y0))[0].dtype
        keys = jax.random.split(key, len(self.varied))
        drawn = {one.target: one.draw(k, dtype) for one, k in zip(self.varied, keys, strict=True)}
        of_args = {name: x for name, x in drawn.items() if name.startswith("args")}
        if of_args:
            problem = problem.with_args(_replaced("args", problem.args, of_args))
        if len(of_args) < len(drawn):
            problem = problem.with_initial(_replaced("y0", problem.y0, drawn))
        values = eqx.filter(problem.constraint, eqx.is_array)
        return problem.y0, DrawnArgs(problem.args, values, drawn)

    def saved(self, t: Any, y: Any, given: DrawnArgs) -> dict[str, Any]:
        """Return the state, its (absolute) constraint violation, and the drawn numbers."""
        residual = jfu.ravel_pytree(self.constraint(t, y, given))[0]
        return {"y": y, "violation": jnp.max(jnp.abs(residual)), "varied": given.drawn}


class ConstraintInArgs(AbstractConstraint):
    """A constraint whose arrays are taken from the [`DrawnArgs`][] of each trajectory."""

    template: AbstractConstraint
    redundant: bool = eqx.field(static=True)

    def _of(self, given: DrawnArgs) -> AbstractConstraint:
        return eqx.combine(given.constraint, self.template)

    def __call__(self, t: Any, y: Any, args: Any = None) -> Any:
        return self._of(args)(t, y, args.args)

    def correct(self, projection: Any, t: Any, y: Any, args: Any = None, **options: Any) -> Any:
        return self._of(args).correct(projection, t, y, args.args, **options)

    def normals(self, projection: Any, t: Any, y: Any, args: Any = None) -> Any:
        return self._of(args).normals(projection, t, y, args.args)

    def push_forward(self, t: Any, y: Any, args: Any, directions: Any, vector: Any) -> Any:
        return self._of(args).push_forward(t, y, args.args, directions, vector)

    def structure_at(self, t: Any, y: Any, args: Any = None) -> Any:
        return self._of(args).structure_at(t, y, args.args)

    def faults(self, t: Any, y: Any, args: Any = None) -> Any:
        return self._of(args).faults(t, y, args.args)


def _for_drawn_args(reset: Reset | ResetAt) -> Reset | ResetAt:
    """Return the reset with functions of the [`DrawnArgs`][] of each trajectory."""

    def jump(t: Any, y: Any, given: DrawnArgs) -> Any:
        return reset.jump(t, y, given.args)

    if isinstance(reset, Reset):
        condition = lambda t, y, given: reset.condition(t, y, given.args)
        return dataclasses.replace(reset, condition=condition, jump=jump)
    times = reset.times
    return ResetAt((lambda given: times(given.args)) if callable(times) else times, jump)


def _names_in(name: str, tree: Any) -> list[str]:
    """Return the names of the numbers in a ravelled tree: `args.length`, `y0.0.1`."""
    out = []
    for path, leaf in jtu.tree_flatten_with_path(tree)[0]:
        path_name = jtu.keystr(path, simple=True, separator=".")
        for index in np.ndindex(*leaf.shape):
            out.append(".".join(filter(None, [name, path_name, *map(str, index)])))
    return out


def _replaced(name: str, tree: Any, drawn: dict[str, Array]) -> Any:
    numbers, unravel = jfu.ravel_pytree(tree)
    for i, target in enumerate(_names_in(name, tree)):
        if target in drawn:
            numbers = numbers.at[i].set(drawn[target])
    return unravel(numbers)
