"""Consistent initial values."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._base.errors import clear_errors, listed
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._constraint.projection_info import ProjectionInfo
from .._constraint.residual import as_time, jacobian, row_scale
from .._constraint.settings import NewtonProjection
from .._linalg.condition import reciprocal_condition, singular_below
from .._linalg.dense import gram
from .._linalg.newton import find_root, implicit_root, without_derivative
from .._linalg.pivoted import factorize_equilibrated
from .equations import leaf_names
from .highest_derivatives import HighestDerivatives
from .layout import Gather, StateLayout
from .nearest import Constrained, depends_on_fixed_only, free_components, nearest_state, with_lifted
from .reduced import Reduced
from .samples import dependent_rows


_MOST_STEPS = 100


class Guess(NamedTuple):
    """A guess of a state, part of which may be fixed."""

    z: Float[Array, " states"]
    w: Float[Array, " n"]  # the leading derivatives
    fixed: tuple[bool, ...]  # for each number of `z`
    names: tuple[str, ...]  # of the unknowns that are fixed, as given

    @staticmethod
    def of(system: Reduced, x: Y, derivatives: Any, fixed: Any) -> "Guess":
        given = [_flat(system, x, "x_guess")]
        given += [_flat(system, dx, f"derivatives[{k}]") for k, dx in enumerate(derivatives)]
        layout, every = system.analysis.layout, jnp.concatenate(given)
        z, w = (
            _places_in_guess(layout, names, len(given))(every, None)
            for names in (layout.names, layout.leading_names())
        )
        return Guess(z, w, _fixed(system, x, fixed), tuple(fixed))


def _places_in_guess(layout: StateLayout, names: np.ndarray, number: int) -> Gather:
    """Return where each of these numbers is in the `number` guesses of `x, x', ...`: under its own
    name, or as a derivative of another unknown of which it is an alias."""
    aliases, n = layout.aliases, len(layout.aliases.root)
    index, scale = [], []
    for k, unknown in names.tolist():
        level = k + aliases.shift[unknown] - aliases.shift
        (others,) = np.nonzero(
            (aliases.root == aliases.root[unknown]) & (level >= 0) & (level < number)
        )
        other = unknown if unknown in others else next(iter(others), unknown)
        index.append(level[other] * n + other if other in others else -1)
        scale.append(aliases.factor[unknown] / aliases.factor[other])
    return Gather(np.array(index, int), np.array(scale, float))


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


def _fixed(system: Reduced, x: Y, fixed: Any) -> tuple[bool, ...]:
    if isinstance(fixed, str) or not all(isinstance(name, str) for name in fixed):
        raise TypeError(
            f"`fixed` must be a tuple of names, such as ('{system.equations.names.unknowns[0]}',), got {fixed!r}."
        )
    names = system.analysis.layout.names.tolist()
    states = [system.equations.names.derivative(unknown, k) for k, unknown in names]
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
    return tuple(held.tolist())


def consistent_state(
    system: Reduced, t0: RealScalarLike, guess: Guess, args: Args, throw: bool
) -> tuple[Array, ProjectionInfo]:
    t = as_time(t0, guess.z.dtype)
    z, info, nonsingular = _find_consistent_state(system, t, guess, args)
    if throw:
        leading = system.leading_equations(t, system.split(z)[0], args)
        _explain(leading, guess, info, nonsingular)
        near = info.residual <= NewtonProjection().tolerance_for(z.dtype)
        cause = jnp.where(info.full_rank, jnp.where(near, 2, 1), 0)
        cause = jnp.where(info.success, 0, cause)
        z = _raise_unless(info.success, z, cause, tuple(_messages(guess, system.analysis.implicit)))
    return z, info


@clear_errors
@eqx.filter_jit
def _raise_unless(success: BoolScalar, z: Array, cause: Array, messages: tuple[str, ...]) -> Array:
    return eqx.branched_error_if(z, ~success, cause, messages)


@numbers_as_arrays("args")
@eqx.filter_jit
def _find_consistent_state(
    system: Reduced, t: Array, given: Guess, args: Args
) -> tuple[Array, ProjectionInfo, BoolScalar]:
    """Return the state nearest to the guess, with the leading derivatives in the implicit form, what
    was done, and whether the matrix of the leading derivatives is nonsingular there."""
    w, finite, implicit = given.w, jnp.all(jnp.isfinite(given.z)), system.analysis.implicit
    guess = jnp.where(finite, given.z, 0)
    nearest = nearest_state(Constrained(system, t, args, w, given.fixed), guess)
    z = with_lifted(system, t, nearest.z, args)
    solvable = jnp.asarray(True)
    if implicit:
        w, solvable = _solve_leading_equations(system.leading_equations(t, z, args), w)
    leading, fixed_w = without_derivative((system.leading_equations(t, z, args), w))
    nonsingular = leading.linearize(fixed_w).usable
    scaled_residual, full_rank = _check_constraints(system, leading, fixed_w, given.fixed)
    near = scaled_residual <= NewtonProjection().tolerance_for(z.dtype)
    success = finite & near & nearest.settled & full_rank & nonsingular & solvable
    correction = jnp.max(jnp.abs(leading.z - guess) / (jnp.abs(guess) + 1), initial=0)
    info = ProjectionInfo(
        multipliers=nearest.multipliers,
        iterations=nearest.iterations,
        residual=jnp.where(finite, scaled_residual, jnp.nan),
        correction=jax.lax.stop_gradient(correction),
        full_rank=full_rank,
        success=success,
    )
    z = jnp.where(finite, z, given.z)
    return jnp.concatenate([z, w]) if implicit else z, info, nonsingular


def _check_constraints(
    system: Reduced,
    leading: HighestDerivatives,
    w: Float[Array, " n"],
    fixed: tuple[bool, ...],
) -> tuple[FloatScalar, BoolScalar]:
    """Return the largest scaled residual of the hidden constraints at a state, and whether their
    gradients with respect to free components are independent."""
    t, z, args, c = leading.t, leading.z, leading.args, system.analysis.c
    g = lambda z: system.hidden_constraints(t, z, args, 0, c, w)
    r, G = jacobian(g, z)
    if r.size == 0:  # there may be no state at all
        return jnp.zeros((), z.dtype), jnp.asarray(True)
    free = free_components(fixed, z)
    idle = jnp.diag(depends_on_fixed_only(g, z, fixed).astype(z.dtype))
    full_rank = factorize_equilibrated(gram(G, G * free[None, :]) + idle).usable
    return jnp.max(jnp.abs(r) / row_scale(G, z)), full_rank


def _solve_leading_equations(
    leading: HighestDerivatives, guess: Float[Array, " k"]
) -> tuple[Float[Array, " k"], BoolScalar]:
    """Return the leading derivatives near a guess, and whether they solve the equations."""
    fixed, tolerance = without_derivative(leading), NewtonProjection().tolerance_for(guess.dtype)
    found = find_root(leading, guess, _MOST_STEPS, tolerance)
    change = fixed.linearize(found).solve(fixed.residual(found))
    small = jnp.max(jnp.abs(change) / (1 + jnp.abs(found)), initial=0) <= 1e3 * tolerance
    return implicit_root(leading, found), jax.lax.stop_gradient(small)


def _messages(guess: Guess, implicit: bool) -> list[str]:
    held = f" with {listed(list(guess.names))} fixed" if guess.names else ""
    advice = " Fix less, or other unknowns." if guess.names else ""
    other_form = (
        ""
        if implicit
        else " If they are independent, but some by less than 1e-8 of the others (diodes at rest), write "
        "`mj.reduce_dae(..., form='index-1')`."
    )
    return [
        f"The equations of `F` and their derivatives cannot be satisfied near `x_guess`{held}: they depend on each "
        f"other there.{advice} Remove equations that follow from others, or start elsewhere.{other_form}",
        f"No state near `x_guess` satisfies the equations of `F` and their derivatives{held}.{advice} Start closer, or "
        "check that they can hold at the same time.",
        "The equations of `F` do not determine all derivatives at the start: some depend on the others there "
        "(redundant), or it is a singular configuration.",
    ]


def _explain(
    leading: HighestDerivatives, guess: Guess, info: ProjectionInfo, nonsingular: BoolScalar
) -> None:
    """Raise with the names of the equations that are singular, if numbers are known."""
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((leading, info))):
        return
    if bool(info.success) or (any(guess.fixed) and bool(nonsingular)):
        return
    matrix = sp.csr_array(np.asarray(leading.matrix()))
    if not np.isfinite(matrix.data).all():
        raise ValueError(
            "`F` or its derivatives are not finite at the start. Give an `x_guess` where they are."
        )
    if reciprocal_condition(matrix) > 10 * singular_below(matrix.dtype):
        return
    names = leading.equations.names.equations
    rows = leading.analysis.rows[dependent_rows(matrix)]
    raise ValueError(
        f"The equations {listed([names[i] for i in rows])} of `F`, differentiated as often as necessary, depend on each "
        "other at the start: they are redundant (remove one of them), or this is a singular configuration (start "
        "elsewhere). The derivatives are not determined there."
    )
