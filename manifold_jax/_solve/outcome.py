"""The result of a solve: failures that Diffrax reports as success, and messages of failures."""

from collections.abc import Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array

from .._base.compat import messages_of_results, nonlinear_failure, number_of_result, save_y
from .._base.types import BoolScalar, IntScalar
from .._constraint.settings import NewtonProjection
from .._rosenbrock import AbstractMassMatrixSolver
from .._solver import Projected
from .._solver.base import AbstractManifoldSolver
from .._solver.step.hook_state import StepStatistics


_NOT_CORRECTED = (
    "A step could not be moved onto the manifold: near its end `constraint` or the vector field is not finite, or the "
    "equations of `constraint` cannot hold or depend on each other, or those of an implicit stage have no solution. "
    "With constant steps try a smaller `dt0` or an adaptive `stepsize_controller`."
)
_TOO_LONG = (
    "A step was beyond the stability interval of `stabilization`: gain * step must stay below that of the solver on the "
    "negative real axis. Use a smaller gain or shorter steps."
)
_NOT_FINITE = (
    "The state is not finite (NaN or infinite) from some time on: the vector field is not defined on the way. For an "
    "`mj.MechanicalSystem` the mass matrix is not positive definite there, or constraints depend on each other; for a "
    "DAE with algebraic equations these no longer determine the algebraic unknowns."
)
_NAN_INSIDE = (
    "The search for an event, or for a stage of an implicit method, met NaN: a function in `event` or `resets` or the "
    "vector field in `terms` is not defined near the step."
)
NO_TIME = "`t0` or `t1` is NaN (or `t0` infinite): nothing was solved."
_SINGULAR = (
    "A step could not be made: `y0` does not satisfy the algebraic equations (see "
    "`mj.MassMatrixTerm.consistent_state`), or the matrix M - h gamma df/dy is singular or not finite, as where the index "
    "of M y' = f is above 1 (reduce it, for example with `mj.reduce_dae`) or a mass that was zero is not any more (give "
    "the times as `jump_ts` of `diffrax.ClipStepSizeController`), or the stages of `mj.RadauIIA5` have no solution at this "
    "step size."
)
_TOO_MANY = (
    "The maximum number of solver steps was reached. A long solve needs a larger `max_steps`, a stiff one `mj.Rodas5P()`; "
    "steps become tiny near a singular configuration (`throw=False` says in `sol.ts` when), and with a tolerance "
    'below the round-off of 32-bit numbers (`jax.config.update("jax_enable_x64", True)`).'
)
NOT_FINITE_START = (
    "`y0` has numbers that are NaN or infinite: nothing was solved. Start from a finite state."
)
UNUSABLE_START = (
    "`y0` could not be made consistent with `constraint`: no nearby state satisfies the equations, their Jacobian does "
    "not have full rank there, or they are not finite. `mj.consistent_state(constraint, t0, y0, args)` of this one says "
    "which."
)
_NOT_TANGENT = (
    "The maximum number of solver steps was reached, and the corrections undid a large part of every step: the vector "
    "field in `terms` is not tangent to the manifold. Make it so with `mj.tangent_field(f, constraint)`, or see "
    "whether `terms` and `constraint` belong together."
)


def result_of_saved(saveat: dfx.SaveAt, ts: Any, ys: Any) -> RESULTS:
    """Return `RESULTS.nonfinite` if a saved state is NaN or infinite at a time that was reached."""
    finite = jnp.asarray(True)

    def check(sub: dfx.SubSaveAt, ts: Array, ys: Any) -> None:
        nonlocal finite
        if sub.fn is not save_y:
            return
        for leaf in jtu.tree_leaves(ys):
            row = jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))
            finite &= jnp.all(row | ~jnp.isfinite(ts))

    jtu.tree_map(check, saveat.subs, ts, ys, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    return RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite)  # pyright: ignore[reportArgumentType]


def messages_for(solver: dfx.AbstractSolver) -> list[str]:
    """Return the messages of the result codes, by number, with more detail than those of Diffrax."""
    messages = messages_of_results()
    texts = [(RESULTS.max_steps_reached, _TOO_MANY), (RESULTS.nonfinite, _NOT_FINITE)]
    texts.append((RESULTS.nonfinite_input, _NAN_INSIDE))
    if isinstance(solver, AbstractManifoldSolver):
        text = _NOT_CORRECTED if solver.corrects_output else _TOO_LONG
        texts.append((nonlinear_failure(), text))
    elif isinstance(solver, AbstractMassMatrixSolver):
        texts.append((nonlinear_failure(), _SINGULAR))
    for result, text in texts:
        messages[int(number_of_result(result))] = text
    return messages


def is_unusable_start(number: Any, num_steps: Any) -> Any:
    """Whether a trajectory failed before its first step, from the number of its result code."""
    return (number == number_of_result(nonlinear_failure())) & (num_steps == 0)


def is_without_time(number: Any, num_steps: Any) -> Any:
    """Whether a trajectory failed because a time is NaN, from the number of its result code."""
    code = number_of_result(RESULTS.nonfinite_input)  # pyright: ignore[reportArgumentType]
    return (number == code) & (num_steps == 0)


def tangency_fault(
    solver: dfx.AbstractSolver, sol: dfx.Solution, state: Any
) -> list[tuple[BoolScalar, str]]:
    """Return whether too many steps were taken because the field is not tangent, and the message.
    `state` is that of the hook at the end."""
    if not isinstance(solver, Projected):
        return []
    undone = _undo_steps(state.statistics, sol.stats["num_accepted_steps"], solver.projection)
    return [(undone & (sol.result == RESULTS.max_steps_reached), _NOT_TANGENT)]


def _undo_steps(
    statistics: StepStatistics, num_accepted_steps: IntScalar, projection: NewtonProjection
) -> BoolScalar:
    """Whether the corrections undid more of the steps than they do for tangent fields.

    There they are as small as errors: over the gallery with tolerances from 1e-8 to 1e-3 up to 7 times
    the tolerance per length travelled. If a part of the field is normal, they are that part of the
    length whatever the tolerance.
    """
    dtype = statistics.correction.dtype
    share = jnp.asarray(1e-2, dtype)
    if projection.rtol is not None and projection.atol is not None:
        tolerance = jnp.asarray(projection.rtol, dtype) + jnp.asarray(projection.atol, dtype)
        share = jnp.minimum(share, 1e3 * tolerance)
    rounding = 1e3 * jnp.finfo(dtype).eps * jnp.asarray(num_accepted_steps, dtype)
    return statistics.correction > share * statistics.displacement + rounding


def raise_if_failed(
    sol: dfx.Solution,
    failed: BoolScalar,
    solver: dfx.AbstractSolver,
    faults: Sequence[tuple[BoolScalar, str]] = (),
) -> dfx.Solution:
    """Attach the message of the last of the `faults` that applies, or that of the result."""
    messages, number = messages_for(solver), number_of_result(sol.result)
    for fault, message in faults:
        number = jnp.where(fault, len(messages), number)
        messages.append(message)
    # For a batch the largest number is reported.
    return eqx.branched_error_if(sol, failed, jnp.where(failed, number, 0), messages)
