"""Consistent initial values."""

import dataclasses

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._base.errors import clear_errors, listed
from .._base.numbers import numbers_as_arrays
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike
from .._constraint.projection_info import ProjectionInfo
from .._constraint.residual import as_time, jacobian, row_scale
from .._constraint.settings import NewtonProjection
from .._linalg.condition import reciprocal_condition, singular_below
from .._linalg.dense import gram
from .._linalg.newton import find_root, implicit_root, without_derivative
from .._linalg.pivoted import factorize_equilibrated
from .dependent_equations import DependentEquations
from .guess import Guess
from .highest_derivatives import HighestDerivatives
from .nearest import Constrained, depends_on_fixed_only, free_components, nearest_state, with_lifted
from .reduced import Reduced


_MOST_STEPS = 100

_GIVE_DERIVATIVES = "give others by `derivatives`, of an unknown `x` by `derivatives=({'x': 1.0},)`"


def consistent_state(
    system: Reduced, t0: RealScalarLike, guess: Guess, args: Args, throw: bool
) -> tuple[Array, ProjectionInfo]:
    t = as_time(t0, guess.z.dtype)
    z, info, nonsingular = _find_consistent_state(system, t, guess, args)
    if throw:
        leading = system.leading_equations(t, system.split(z)[0], args)
        near = info.residual <= NewtonProjection().tolerance_for(z.dtype)
        _explain(leading, guess, info, nonsingular)
        cause = jnp.where(info.full_rank, jnp.where(near, 2, 1), jnp.where(near, 0, 3))
        cause = jnp.where(info.success, 0, cause)
        z = _raise_unless(info.success, z, cause, tuple(_messages(guess, leading)))
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


def _messages(guess: Guess, leading: HighestDerivatives) -> list[str]:
    unguessed = _unguessed(leading, guess)
    held = f" with {listed(list(guess.names))} fixed" if guess.names else ""
    advice = " Fix less, or other unknowns." if guess.names else ""
    other_form = (
        ""
        if leading.analysis.implicit
        else " If they are independent, but some by less than 1e-8 of the others (diodes at rest), write "
        "`mj.reduce_dae(..., form='index-1')`."
    )
    zero = f" The guess of {unguessed} is zero; {_GIVE_DERIVATIVES}." if unguessed else ""
    return [
        f"The equations of `F` and their derivatives cannot be satisfied near `x_guess`{held}: they depend on each "
        f"other there.{advice} Remove equations that follow from others, or start elsewhere.{zero}{other_form}",
        f"No state near `x_guess` satisfies the equations of `F` and their derivatives{held}.{advice} Start closer, or "
        f"check that they can hold at the same time.{zero}",
        "The equations of `F` do not determine all derivatives at the start: some depend on the others there "
        f"(redundant), or it is a singular configuration.{zero}",
        f"No state near `x_guess` satisfies the equations of `F` and their derivatives{held}: where the search for one ended, "
        f"they depend on each other.{advice} Check that they can hold at the same time, remove equations that follow from "
        f"others, or start elsewhere.{zero}{other_form}",
    ]


def _unguessed(leading: HighestDerivatives, guess: Guess) -> str:
    """Return the names of the unknown derivatives of which no guess is given, in the order of the state."""
    layout, equations = leading.analysis.layout, leading.equations
    names = [layout.names[guess.zero[0]]]
    if leading.analysis.implicit:
        names.append(layout.leading_names()[guess.zero[1]])
    found = np.concatenate(names).tolist()
    return listed([equations.names.derivative(unknown, k) for k, unknown in found])


def _singular_by_guess(leading: HighestDerivatives, guess: Guess) -> bool:
    """Whether the leading equations are regular with numbers other than zero for the derivatives of which no
    guess is given."""
    random = np.random.default_rng(0)
    z, w = (
        jnp.where(zero, jnp.asarray(random.normal(size=x.shape), x.dtype), x)
        for x, zero in zip((leading.z, guess.w), guess.zero, strict=True)
    )
    matrix = sp.csr_array(np.asarray(dataclasses.replace(leading, z=z).matrix(w)))
    regular = reciprocal_condition(matrix) > 10 * singular_below(matrix.dtype)
    return bool(np.isfinite(matrix.data).all()) and regular


def _explain(
    leading: HighestDerivatives, guess: Guess, info: ProjectionInfo, nonsingular: BoolScalar
) -> None:
    """Raise with the names of the equations that are singular, if numbers are known."""
    if any(isinstance(x, jax.core.Tracer) for x in jtu.tree_leaves((leading, info))):
        return
    if bool(info.success) or (any(guess.fixed) and bool(nonsingular)):
        return
    if not info.residual <= NewtonProjection().tolerance_for(leading.z.dtype):
        # Where the iterations ended tells nothing: that is no state.
        leading = dataclasses.replace(leading, z=guess.z)
    matrix = sp.csr_array(np.asarray(leading.matrix(guess.w)))
    if not np.isfinite(matrix.data).all():
        raise ValueError(
            "`F` or its derivatives are not finite at the start. Give an `x_guess` where they are."
        )
    if reciprocal_condition(matrix) > 10 * singular_below(matrix.dtype):
        return
    equations, vanishing = DependentEquations.of(leading.analysis, matrix)
    unguessed = _unguessed(leading, guess)
    if unguessed and _singular_by_guess(leading, guess):
        raise ValueError(
            f"The equations {equations} of `F` do not determine the derivatives where {unguessed} is zero, which is the guess "
            f"if none is given: {_GIVE_DERIVATIVES}."
        )
    if vanishing:
        raise ValueError(
            f"The coefficients of {vanishing} in the equation {equations} of `F`, differentiated as often as necessary, are zero "
            "at the start, and do not determine the derivatives. If a parameter in `args` is zero, give another number, or "
            "write the equation without the terms that vanish (and reduce it again); otherwise start elsewhere."
        )
    raise ValueError(
        f"The equations {equations} of `F`, differentiated as often as necessary, depend on each other at the start: they "
        "are redundant (remove one of them), or this is a singular configuration (start elsewhere). The derivatives "
        "are not determined there."
    )
