"""The perturbation approach: correct the state onto the manifold after every step."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array

from .._compat import is_okay, nonlinear_failure, time_direction, update_result
from .._constraint import AbstractConstraint, check_constraint
from .._custom_types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike, Y
from .._interpolation import CorrectedInterpolationFactory
from .._projection import NewtonProjection, ProjectionInfo
from .base import AbstractManifoldSolver, check_inner_solver, check_noise
from .explicit import explicit_step, is_first_same_as_last, is_unrollable, refreshed


class ProjectionStatistics(eqx.Module):
    """Totals over the accepted steps of a solve."""

    iterations: IntScalar
    largest_correction: FloatScalar

    @staticmethod
    def zero(y: Y) -> "ProjectionStatistics":
        dtype = jnp.result_type(*jtu.tree_leaves(y))
        return ProjectionStatistics(jnp.zeros((), jnp.int32), jnp.zeros((), dtype))

    def including(self, info: ProjectionInfo) -> "ProjectionStatistics":
        return ProjectionStatistics(
            self.iterations + info.iterations,
            jnp.maximum(
                self.largest_correction, info.correction.astype(self.largest_correction.dtype)
            ),
        )


class ProjectedState(eqx.Module):
    """Carried from step to step: the wrapped solver's own state, the size of the first step
    that was tried (the scale of time near t = 0), and the totals."""

    inner: Any
    first_step: FloatScalar
    statistics: ProjectionStatistics


class Projected(AbstractManifoldSolver):
    """Any one-step solver, followed by a correction of the state onto the manifold:
    `y1 = pi(Phi_h(y0))`, `g(t1, y1, args) = 0` (projection; the paper's perturbation approach).

    The order of the wrapped solver is kept, and the step sizes are chosen by its own error
    estimate. A step that cannot be corrected is rejected and repeated with a smaller one;
    if no smaller one is possible (constant steps, or steps at the limit of the time's
    precision) the solve ends with `RESULTS.nonlinear_divergence`.

    Works with `diffrax.diffeqsolve`, where every *step* ends on the manifold; use
    [`mj.diffeqsolve`][] to have the initial value, every saved value, events and the dense
    solution there too.

    **Arguments:**

    - `solver`: a Runge-Kutta type solver of Diffrax: explicit, (singly) diagonally implicit,
        implicit-explicit, `HalfSolver` around an explicit one, or a Stratonovich solver.
    - `constraint`: the manifold.
    - `projection`: metric, iteration limit and tolerance, [`NewtonProjection`][].

    **Raises:**

    `ValueError` for solvers that carry past values of `y` (leapfrog, reversible) and for
    Ito solvers of stochastic equations: projection makes them converge to the Stratonovich
    solution.

    Projection guarantees the constraint, not a smaller error: usually the error shrinks,
    sometimes it grows (compare with `manifold-jax compare`).

    Source: Sudarsan & Keerthi (1998), section 3.4; Shampine, Comp. Math. Appl. 12B (1986)
    1287-1296; Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482.
    """

    inner: dfx.AbstractSolver
    constraint: AbstractConstraint
    projection: NewtonProjection
    # Off where `mj.diffeqsolve` corrects every interpolated value, which makes them continuous
    # by itself: the same correction of the same point. Bending costs more than interpolating.
    bend_interpolant: bool

    def __init__(
        self,
        solver: dfx.AbstractSolver,
        constraint: AbstractConstraint,
        *,
        projection: NewtonProjection | None = None,
    ):
        check_inner_solver(solver, "Projected")
        if not isinstance(constraint, AbstractConstraint):
            raise TypeError(
                f"`constraint` must be an `mj.Constraint`, got {type(constraint).__name__}. "
                "Wrap a residual function: `mj.Constraint(lambda t, y, args: ...)`."
            )
        self.inner = solver
        self.constraint = constraint
        self.projection = NewtonProjection() if projection is None else projection
        self.bend_interpolant = True

    @property
    def interpolation_cls(self):  # pyright: ignore
        return CorrectedInterpolationFactory(self.inner.interpolation_cls, self.bend_interpolant)

    def init(
        self, terms, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> ProjectedState:
        check_noise(self.solver, terms)
        check_constraint(self.constraint, t0, y0, args)
        if is_unrollable(self.inner, terms, t0, t1, y0, args):
            fsal = is_first_same_as_last(self.inner.tableau)  # pyright: ignore
            inner_state = terms.vf(t0, y0, args) if fsal else None
        else:
            inner_state = self.inner.init(terms, t0, t1, y0, args)
        first_step = jnp.abs(jnp.asarray(t1) - t0)
        return ProjectedState(inner_state, first_step, ProjectionStatistics.zero(y0))

    def step(
        self,
        terms,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: ProjectedState,
        made_jump: Any,
    ) -> tuple[Y, Y | None, dict[str, Any], ProjectedState, RESULTS]:
        time = t1 * time_direction(terms)

        def correct(y: Y) -> tuple[Y, ProjectionInfo]:
            return self.projection(self.constraint, time, y, args, fallback=y0)

        if is_unrollable(self.inner, terms, t0, t1, y0, args):
            tableau = self.inner.tableau  # pyright: ignore
            fsal = is_first_same_as_last(tableau)
            evaluate = lambda: terms.vf(t0, y0, args)
            f0 = refreshed(made_jump, solver_state.inner, evaluate) if fsal else evaluate()
            y1, raw, error, dense_info, f1, info = explicit_step(
                tableau, terms, t0, t1, y0, args, f0, correct
            )
            inner_state, result = (f1 if fsal else None), RESULTS.successful
        else:
            # The derivative that the solver carried over belongs to the uncorrected state.
            # Diffrax evaluates it anew if any lane of a batch needs it, so that keeping it
            # would make the lanes depend on each other; always evaluating it does not.
            raw, error, dense_info, inner_state, result = self.inner.step(
                terms, t0, t1, y0, args, solver_state.inner, made_jump=True
            )
            y1, info = correct(raw)
        result = update_result(
            result, RESULTS.where(info.success, RESULTS.successful, nonlinear_failure())
        )
        if error is not None:
            repeatable = _is_repeatable(t0, t1, solver_state.first_step)
            if self.projection.rtol is not None:
                error = _at_least(error, raw, y1, repeatable)
            error = _rejecting(error, is_okay(result), repeatable)
        correction = jtu.tree_map(jnp.subtract, y1, raw)
        dense_info = dict(corrected=y1, correction=correction, **dense_info)
        statistics = solver_state.statistics.including(info)
        state = ProjectedState(inner_state, solver_state.first_step, statistics)
        return y1, error, dense_info, state, result


def _is_repeatable(t0: RealScalarLike, t1: RealScalarLike, first_step: FloatScalar) -> BoolScalar:
    """Whether a smaller step is possible at all within the precision of the time."""
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    scale = jnp.maximum(jnp.maximum(jnp.abs(t0), jnp.abs(t1)), first_step)
    smallest = 100 * jnp.finfo(t1.dtype).eps * scale
    return jnp.abs(t1 - t0) > smallest


def _at_least(error: Y, raw: Y, y1: Y, repeatable: BoolScalar) -> Y:
    """The correction is a lower bound of the local error (Sudarsan & Keerthi 1998, 3.4).

    Unless the step started off the manifold: then no step is small enough, and the smallest
    one is let through.
    """

    def raised(e: Array, a: Array, b: Array) -> Array:
        bound = jax.lax.stop_gradient(jnp.abs(a - b))
        return jnp.where(repeatable, jnp.maximum(jnp.abs(e), bound), e)

    return jtu.tree_map(raised, error, y1, raw)


def _rejecting(error: Y, success: BoolScalar, repeatable: BoolScalar) -> Y:
    """Error estimate of a step that may have failed.

    An infinite error makes an adaptive controller reject the step and try a smaller one.
    Where there is none the step is let through, and its result code ends the solve.
    """
    verdict = jnp.where(repeatable, jnp.inf, 0.0)
    return jtu.tree_map(lambda e: jnp.where(success, e, verdict.astype(e.dtype)), error)
