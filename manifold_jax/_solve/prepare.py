"""What is done before the loop: types, the initial value, and the first step."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._base.types import Args, RealScalarLike, Y
from .._constraint.checks import check_constraint, check_state
from .._rosenbrock import AbstractRosenbrock, MassMatrixTerm
from .._solver.base import AbstractManifoldSolver, controller_tolerances
from .._solver.step.advance import HookState
from .._solver.step.execution import ExplicitStep
from .._solver.terms import DirectedTerm
from .._solver.unconstrained import Unconstrained
from .first_step import first_step, FirstStep
from .mass_matrix import consistent_with_mass
from .start import Consistent, start_state, StartInfo


class Ready(NamedTuple):
    """What a loop starts from; all times in one type of number. The state of the solver, where it
    is known without `solver.init`."""

    t0: Array
    t1: Array
    dt0: RealScalarLike | None
    y0: Y
    solver_state: HookState | None
    start: StartInfo


def prepare(
    terms: Any,
    solver: AbstractManifoldSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    dt0: RealScalarLike | None,
    y0: Y,
    args: Args,
    saveat: dfx.SaveAt,
    controller: dfx.AbstractStepSizeController,
    consistent: Consistent,
    throw: bool,
) -> Ready:
    """`controller` chooses the first step if `dt0` is None."""
    dtype = time_dtype(t0, t1, dt0, saveat)
    y0 = as_state(y0, dtype)
    t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    y0, moved = consistent_with_mass(terms, t0, y0, args, consistent, throw)
    if isinstance(solver, Unconstrained):
        start = StartInfo(jnp.zeros((), dtype), jnp.asarray(True))
    else:
        check_constraint(solver.constraint, t0, y0, args)
        y0, start = start_state(
            solver.constraint, t0, y0, args, solver.projection, consistent, throw
        )
    if moved is not None:
        start = start._replace(correction=jnp.maximum(moved, start.correction))
    solver_state = None
    if (
        dt0 is None
        and _is_first_step_chosen_here(solver)
        and (first := chosen_first_step(terms, solver, t0, t1, y0, args, controller))
    ):
        dt0 = first.size
        solver_state = _solver_state(terms, solver, t0, y0, args, first)
    if not throw:  # what starts with NaN ends before its first step
        y0 = jtu.tree_map(lambda leaf: jnp.where(start.success, leaf, jnp.nan), y0)
    return Ready(t0, t1, dt0, y0, solver_state, start)


def _is_first_step_chosen_here(solver: AbstractManifoldSolver) -> bool:
    """A method of Diffrax without a constraint is left to the choice of Diffrax, for comparisons."""
    return not isinstance(solver, Unconstrained) or isinstance(solver.inner, AbstractRosenbrock)


def time_dtype(t0: Any, t1: Any, dt0: Any, saveat: dfx.SaveAt) -> Any:
    """The type in which Diffrax will hold times, and the least precision of the state."""
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    times = [t for t in (t0, t1, dt0, *(s.ts for s in subs)) if t is not None]
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*times)
        return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)


def as_state(y0: Y, dtype: Any) -> Y:
    check_state(y0, "y0")
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf, dtype)), y0)


def chosen_first_step(terms, solver, t0, t1, y0, args, controller) -> FirstStep | None:
    tolerances = controller_tolerances(controller)
    if isinstance(terms, MassMatrixTerm):
        terms = dfx.ODETerm(terms.derivative)
    if tolerances is None or not isinstance(terms, dfx.ODETerm | DirectedTerm):
        return None
    return first_step(terms, solver, t0, t1, y0, args, tolerances)


def _solver_state(
    terms: Any, solver: AbstractManifoldSolver, t0: Array, y0: Y, args: Args, first: FirstStep
) -> HookState | None:
    """What `solver.init` would evaluate the vector field for once more, if it is that of `terms`."""
    t1 = t0 + first.size
    execution = solver.execution(terms, t0, t1, y0, args)
    rewritten = solver.prepare_terms(terms) is not terms
    if rewritten or not isinstance(execution, ExplicitStep):
        return None
    memory = first.field if execution.remembers_field else None
    return HookState.initial(memory, t0, t1, y0)
