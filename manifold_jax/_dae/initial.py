"""Consistent initial values."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, BoolScalar, RealScalarLike, Y
from .._newton import AbstractEquations, find_root, implicit_root, without_derivative
from .._projection import NewtonProjection
from .._projection_info import ProjectionInfo
from .._residual import as_time, jacobian, row_scale
from .constraint import hidden_constraints, Reduced, ReducedConstraint
from .names import leaf_names, listed
from .pivots import Pivoted
from .samples import condition, dependent_rows, singular_below
from .signature import Structure


_MAX_STEPS = 50


class Guess(NamedTuple):
    """A state, and which of its numbers may not move."""

    z: Float[Array, " states"]
    fixed: np.ndarray
    names: tuple[str, ...]  # of what is fixed, as given

    @staticmethod
    def of(system: Reduced, x: Y, derivatives: tuple[Y, ...], fixed: tuple[str, ...]) -> "Guess":
        layout, scale = system.static.plan.layout, system.static.plan.layout.scale()
        given = [_flat(system, x, "x_guess")]
        given += [_flat(system, dx, f"derivatives[{k}]") for k, dx in enumerate(derivatives)]
        aliases, numbers = layout.aliases, []
        for (k, unknown), size in zip(layout.names.tolist(), scale, strict=True):
            same = np.nonzero(aliases.root == aliases.root[unknown])[0]
            level = k + aliases.shift[unknown]
            orders = [(level - aliases.shift[other], other) for other in same]
            known = [(r, other) for r, other in sorted(orders) if 0 <= r < len(given)]
            if known:
                r, other = min(known, key=lambda pair: (pair[0] != k, pair[0]))
                numbers.append(given[r][other] * (size / aliases.factor[other]))
            else:
                numbers.append(jnp.zeros((), given[0].dtype))
        z = jnp.stack(numbers) if numbers else jnp.zeros((0,), given[0].dtype)
        return Guess(z, _fixed(system, x, fixed), fixed)


def _flat(system: Reduced, x: Y, name: str) -> Array:
    leaves, structure = system.equations.shapes
    x = jtu.tree_map(jnp.asarray, x)
    shapes = [leaf.shape for leaf in jtu.tree_leaves(x)]
    if jtu.tree_structure(x) != structure or shapes != [leaf.shape for leaf in leaves]:
        raise ValueError(
            f"`{name}` must be like `x_example`, {structure} of shapes {[leaf.shape for leaf in leaves]}; got "
            f"{jtu.tree_structure(x)} of shapes {shapes}."
        )
    floating = jtu.tree_map(
        lambda leaf, like: leaf.astype(like.dtype), jtu.tree_leaves(x), [*leaves]
    )
    return jfu.ravel_pytree(floating)[0]


def _fixed(system: Reduced, x: Y, fixed: Any) -> np.ndarray:
    if isinstance(fixed, str) or not all(isinstance(name, str) for name in fixed):
        raise TypeError(
            f"`fixed` must be a tuple of names, such as ('{system.equations.names.unknowns[0]}',), got {fixed!r}."
        )
    plan, unknowns = system.static.plan, system.equations.names
    states = [unknowns.derivative(j, k) for k, j in plan.layout.names.tolist()]
    groups = dict(leaf_names(x, "x"))
    held = np.zeros(len(states), bool)
    for name in fixed:
        whole, primes = name.rstrip("'"), len(name) - len(name.rstrip("'"))
        numbers = [entry + "'" * primes for entry in groups.get(whole, [whole])]
        missing = [number for number in numbers if number not in states]
        if missing:
            raise ValueError(
                f"`fixed` names {listed(missing)}, not of the state, whose numbers are {listed(states, 20)}. What "
                "is not in the state follows from it."
            )
        held |= np.isin(states, numbers)
    return held


class _Lifted(AbstractEquations):
    """The equations for the unknowns that became states, `z[where]`, with the others given."""

    system: Reduced
    t: Array
    z: Float[Array, " states"]
    args: Args
    levels: "Levels" = eqx.field(static=True)

    def point(self, z: Float[Array, " lifted"]) -> Float[Array, " states"]:
        return self.z.at[self.levels.states].set(z)

    def residual(self, x: Float[Array, " states"]) -> Float[Array, " lifted"]:
        return hidden_constraints(
            self.system, self.t, x, self.args, self.levels.first, self.levels.end
        )

    def linearize(self, x: Float[Array, " states"]) -> Pivoted:
        along = lambda u: self.residual(x.at[self.levels.states].set(u))
        return Pivoted.of(jax.jacfwd(along)(x[self.levels.states]))


@dataclasses.dataclass(frozen=True, eq=False)
class Levels:
    """Which derivatives of which equations, and which states."""

    first: np.ndarray
    end: np.ndarray
    states: np.ndarray


def consistent_state(
    system: Reduced,
    t0: RealScalarLike,
    guess: Guess,
    args: Args,
    throw: bool,
) -> tuple[Array, ProjectionInfo]:
    z, t = guess.z, as_time(t0, guess.z.dtype)
    layout, unlifted = system.static.plan.layout, system.static.plan.unlifted
    j = np.searchsorted(layout.aliases.roots, layout.aliases.root[layout.names[:, 1]])
    level = layout.names[:, 0] + layout.aliases.shift[layout.names[:, 1]]
    levels = Levels(unlifted.c, layout.structure.c, np.nonzero(level >= unlifted.d[j])[0])
    z, info = _moved(system, unlifted, t, guess, args)
    if len(levels.states) > 0:
        lifted = _Lifted(system, t, z, args, levels)
        root = find_root(without_derivative(lifted), z[levels.states], _MAX_STEPS)
        z = lifted.point(implicit_root(lifted, root))
    residual, regular = _check(system, t, z, args)
    solved = residual <= NewtonProjection().tolerance_for(z.dtype)
    success = info.success & solved & regular
    info = dataclasses.replace(info, residual=residual, success=success)
    if throw:
        _explain(system, t, z, args, guess, info, regular)
        messages = _messages(guess)
        cause = jnp.where(info.full_rank, jnp.where(solved, 2, 1), 0)
        cause = jnp.where(success, 0, cause)
        z = eqx.branched_error_if(z, ~success, cause, messages)
    return z, info


def _moved(
    system: Reduced, unlifted: Structure, t: Array, guess: Guess, args: Args
) -> tuple[Array, ProjectionInfo]:
    """Onto what holds of the state without the unknowns that became states."""
    if unlifted.c.sum() == 0:
        residual = jnp.zeros((), guess.z.dtype)
        finite = jnp.all(jnp.isfinite(guess.z))
        return guess.z, ProjectionInfo.of_formula(guess.z, guess.z, residual, finite)
    weights = jnp.asarray(np.where(guess.fixed, np.inf, 1), guess.z.dtype)
    projection = NewtonProjection(metric=weights, max_steps=_MAX_STEPS)
    manifold = ReducedConstraint(system, tuple(unlifted.c.tolist()))
    return manifold.correct(projection, t, guess.z, args, far=True)


def _check(system: Reduced, t: Array, z: Array, args: Args) -> tuple[Array, BoolScalar]:
    """The largest scaled residual, and whether the derivatives are determined."""
    closing = without_derivative(system.closing(t, z, args))
    regular = closing.linearize(closing.z).full_rank
    manifold = ReducedConstraint(system)
    r, G = jacobian(lambda z: manifold(closing.t, z, closing.args), closing.z)
    if r.size == 0:
        return jnp.zeros((), z.dtype), regular
    return jnp.max(jnp.abs(r) / row_scale(G, closing.z)), regular


def _messages(guess: Guess) -> list[str]:
    held = f" with {listed(list(guess.names))} fixed" if guess.names else ""
    advice = " Fix less, or other unknowns." if guess.names else ""
    return [
        f"The equations of `F` and their derivatives cannot be satisfied near `x_guess`{held}: they depend on each "
        f"other there.{advice} Remove equations that follow from others, or start elsewhere.",
        f"No state near `x_guess` satisfies the equations of `F` and their derivatives{held}.{advice} Start closer, or "
        "check that they can hold at the same time.",
        "The equations of `F` do not determine all derivatives at the start: some depend on the others there "
        "(redundant), or it is a singular configuration.",
    ]


def _explain(
    system: Reduced,
    t: Array,
    z: Array,
    args: Args,
    guess: Guess,
    info: ProjectionInfo,
    regular: BoolScalar,
) -> None:
    """With numbers at hand, say which equations are singular."""
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((t, z, args, info))):
        return
    if bool(info.success) or (guess.fixed.any() and bool(regular)):
        return
    closing = system.closing(t, z, args)
    matrix = np.asarray(closing.matrix())
    if not np.isfinite(matrix).all():
        raise ValueError(
            "`F` or its derivatives are not finite at the start. Give an `x_guess` where they are."
        )
    if condition(matrix) > 10 * singular_below(matrix.dtype):
        return
    names = system.equations.names.equations
    rows = system.static.plan.layout.aliases.rows[dependent_rows(matrix)]
    raise ValueError(
        f"The equations {listed([names[i] for i in rows])} of `F`, differentiated as often as necessary, depend on each "
        "other at the start: they are redundant (remove one of them), or this is a singular configuration (start "
        "elsewhere). The derivatives are not determined there."
    )
