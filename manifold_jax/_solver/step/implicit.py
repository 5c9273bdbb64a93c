"""Implicit stages that are solved to round-off, and a derivative that is carried from step to step."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx

from ..._base.compat import use_stepsize_tol
from ..._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .explicit import refreshed
from .frame import StepFrame


# The most iterations, one less than Diffrax allows. A stage that is not at round-off by then is the
# result of a fixed number of iterations, which does not depend on rounding either.
_MOST = 9


class StageChord(optx.AbstractRootFinder):
    r"""Simplified Newton iteration with one Jacobian per step, as `diffrax.VeryChord`, continued until
    the stage is at round-off: `|dx| <= 8 eps |x|`, or no longer shrinking.

    `VeryChord` stops at a hundredth of the tolerance: rounding decides whether it does so an iteration
    earlier or later, and so do the steps that follow, which then differ between one trajectory and the
    same in a batch. It also takes two iterates at rounding level, of which the second is larger, for
    divergence, and rejects most steps of some problems for that.

    Succeeds where the error of the stage, estimated from the rate $\rho$ of convergence as
    $|dx| \rho / (1 - \rho)$, is below `kappa` times the tolerance.

    Source: Hairer & Wanner, Solving ODEs II, section IV.8 (simplified Newton iterations).
    """

    chord: dfx.VeryChord

    # Replaced by Diffrax if they are inherited from the step size controller.
    @property
    def rtol(self) -> Any:
        return self.chord.rtol

    @property
    def atol(self) -> Any:
        return self.chord.atol

    @property
    def norm(self) -> Any:
        return self.chord.norm

    def init(self, *args: Any, **kwargs: Any) -> Any:
        return self.chord.init(*args, **kwargs)

    def step(self, *args: Any, **kwargs: Any) -> Any:
        return self.chord.step(*args, **kwargs)

    def postprocess(self, *args: Any, **kwargs: Any) -> Any:
        return self.chord.postprocess(*args, **kwargs)

    def terminate(
        self, fn: Any, y: Y, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[BoolScalar, optx.RESULTS]:
        del fn, args, options, tags
        size, begun, twice = state.diffsize, state.step >= 1, state.step >= 2
        rate = size / state.diffsize_prev
        error = size * rate / (1 - rate)
        near = size < self.chord.kappa
        accurate = near | (twice & (error > 0) & (error < self.chord.kappa))
        finished = begun & (size <= self._rounding(y)) | twice & near & (rate > 0.3)
        diverged = begun & ~jnp.isfinite(size) | twice & (rate > 2)
        last, singular = state.step >= _MOST, state.result != optx.RESULTS.successful
        failed = ~finished & (diverged | last & ~accurate)
        result = optx.RESULTS.where(
            failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(singular, state.result, result)
        return finished | diverged | last | singular, result

    def _rounding(self, y: Y) -> FloatScalar:
        def relative(x):
            unit = 8 * jnp.finfo(x.dtype).eps
            return unit * jnp.abs(x) / (self.atol + self.rtol * jnp.abs(x))

        return self.norm(jtu.tree_map(relative, y))


def with_accurate_stages(solver: dfx.AbstractSolver) -> dfx.AbstractSolver:
    """Return the solver with implicit stages solved to round-off, unless the user chose a root finder."""
    if isinstance(getattr(solver, "root_finder", None), dfx.VeryChord):
        return eqx.tree_at(lambda s: s.root_finder, solver, replace_fn=StageChord)  # pyright: ignore[reportArgumentType]
    return solver


def with_tolerances_of_stages(
    solver: Any, controller: dfx.AbstractStepSizeController, y0: Y
) -> Any:
    """Return a solver whose stages have tolerances. With constant steps there are none to inherit.
    Stages are solved to round-off in any case, and count as solved if half of the digits are right."""
    if isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        return solver
    finder, names = getattr(solver, "root_finder", None), ("rtol", "atol", "norm")
    names = [name for name in names if getattr(finder, name, None) is use_stepsize_tol]
    if not names:
        return solver
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(float, *jtu.tree_leaves(y0))
    half = float(jnp.finfo(dtype).eps) ** 0.5
    values = {"rtol": half, "atol": half, "norm": optx.rms_norm}
    missing = lambda s: [getattr(s.root_finder, name) for name in names]
    return eqx.tree_at(missing, solver, [values[name] for name in names])


def carries_derivative(solver: dfx.AbstractSolver, terms: Any, t0, t1, y0: Y, args: Args) -> bool:
    """Whether the first stage of a step is the last one of the step before, in Diffrax's own
    implementation: its solver state is then that derivative, and whether it is known."""
    return (
        isinstance(solver, dfx.AbstractImplicitSolver)
        and isinstance(solver, dfx.AbstractRungeKutta)
        and not isinstance(solver, dfx.AbstractWrappedSolver)
        and all(
            getattr(type(solver), name) is getattr(dfx.AbstractRungeKutta, name)
            for name in ("init", "step", "func")
        )
        and all(tableau.fsal for tableau in _tableaus(solver))
        and not terms.is_vf_expensive(t0, t1, y0, args)
    )


def _tableaus(solver: Any) -> tuple[dfx.ButcherTableau, ...]:
    tableau = solver.tableau
    return (tableau,) if isinstance(tableau, dfx.ButcherTableau) else tableau.tableaus


def step_with_derivative(
    solver: dfx.AbstractSolver,
    terms: Any,
    frame: StepFrame,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    derivative: Any,
    made_jump: Any,
) -> tuple[Y, Y | None, dict[str, Any], Any, Any]:
    """Make a step that begins with `derivative`, which is evaluated again only after a jump of the
    field.

    It belongs to the state before its correction. Where the field is stiff, one evaluated at the
    corrected state would be wrong by the size of the correction times the stiffness. (Diffrax itself
    evaluates it again in all lanes of a batch if one of them needs it.) Coordinates that are not states
    have another one in each step.
    """
    if frame.state is None:
        derivative = refreshed(made_jump, derivative, lambda: solver.func(terms, t0, y0, args))
    else:
        derivative = solver.func(frame.terms, t0, frame.origin, args)
    w1, error, dense_info, (_, derivative), result = solver.step(
        frame.terms, t0, t1, frame.origin, args, (False, derivative), made_jump=False
    )
    return w1, error, dense_info, derivative, result
