"""Preparation of a solve: types, the initial value, and the first step."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import RealScalarLike, Y
from .._constraint.checks import check_constraint, check_state
from .._constraint.constraint import NoConstraint
from .._rosenbrock import AbstractMassMatrixSolver, MassMatrixTerm
from .._solver.base import AbstractManifoldSolver, controller_tolerances
from .._solver.step.execution import ExplicitStep
from .._solver.step.hook_state import HookState
from .._solver.terms import DirectedTerm
from .._solver.unconstrained import Unconstrained
from .first_step import first_step, FirstStep
from .mass_matrix import consistent_with_mass
from .setup import ProblemData, Setup
from .start import start_state, StartInfo


class Ready(NamedTuple):
    """The initial values of a loop, with all times of one dtype, and the state of the solver if it is
    known without `solver.init`."""

    data: ProblemData
    dt0: RealScalarLike | None
    solver_state: HookState | None
    start: StartInfo


def prepare(setup: Setup, data: ProblemData) -> Ready:
    """Make the start consistent, and choose the first step if `dt0` is None. A method of Diffrax
    without a hook is left to Diffrax, for comparisons."""
    if not isinstance(setup.solver, AbstractManifoldSolver | AbstractMassMatrixSolver):
        return Ready(data, setup.dt0, None, StartInfo(jnp.zeros(()), jnp.asarray(True)))
    dtype = time_dtype(data.t0, data.t1, setup.dt0, setup.saveat)
    t0, t1 = jnp.asarray(data.t0, dtype), jnp.asarray(data.t1, dtype)
    y0, start = _start(setup, data._replace(t0=t0, y0=as_state(data.y0, dtype)))
    data = ProblemData(t0, t1, y0, data.args)
    dt0, solver_state = setup.dt0, None
    if dt0 is None and (first := _chosen_first_step(setup, data)):
        dt0 = first.size
        solver_state = _solver_state(setup, data, first)
    if not setup.throw:  # a solve from NaN ends before its first step
        y0 = jtu.tree_map(lambda leaf: jnp.where(start.success, leaf, jnp.nan), y0)
    return Ready(data._replace(y0=y0), dt0, solver_state, start)


def _start(setup: Setup, data: ProblemData) -> tuple[Y, StartInfo]:
    y0, moved = consistent_with_mass(setup, data)
    constraint = getattr(setup.solver, "constraint", NoConstraint())
    if isinstance(constraint, NoConstraint):
        start = StartInfo(jnp.zeros_like(data.t0), jnp.asarray(True))
    else:
        check_constraint(constraint, data.t0, y0, data.args)
        y0, start = start_state(setup, data._replace(y0=y0))
    if moved is not None:
        start = start._replace(correction=jnp.maximum(moved, start.correction))
    return y0, start


def time_dtype(t0: Any, t1: Any, dt0: Any, saveat: dfx.SaveAt) -> Any:
    """Return the dtype in which Diffrax will hold times; that of states is at least as precise."""
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    times = [t for t in (t0, t1, dt0, *(s.ts for s in subs)) if t is not None]
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*times)
        return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)


def as_state(y0: Y, dtype: Any) -> Y:
    check_state(y0, "y0")
    with jax.numpy_dtype_promotion("standard"):
        return jtu.tree_map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf, dtype)), y0)


def _chosen_first_step(setup: Setup, data: ProblemData) -> FirstStep | None:
    terms, tolerances = setup.terms, controller_tolerances(setup.controller)
    inner = getattr(setup.solver, "inner", setup.solver)
    if isinstance(setup.solver, Unconstrained) and not isinstance(inner, AbstractMassMatrixSolver):
        return None  # left to Diffrax
    if isinstance(terms, MassMatrixTerm):
        terms = dfx.ODETerm(terms.derivative)
    if tolerances is None or not isinstance(terms, dfx.ODETerm | DirectedTerm):
        return None
    return first_step(terms, setup.solver, data, tolerances)


def _solver_state(setup: Setup, data: ProblemData, first: FirstStep) -> HookState | None:
    """Return the state of the solver from the vector field `f0` of `terms`, which `solver.init` would
    evaluate again."""
    terms, solver, (t0, _, y0, args) = setup.terms, setup.solver, data
    if not isinstance(solver, AbstractManifoldSolver) or solver.prepare_terms(terms) is not terms:
        return None
    t1 = t0 + first.size
    execution = solver.execution(terms, t0, t1, y0, args)
    if not isinstance(execution, ExplicitStep):
        return None
    memory = first.field if execution.remembers_field else None
    return HookState.initial(memory, t0, t1, y0)
