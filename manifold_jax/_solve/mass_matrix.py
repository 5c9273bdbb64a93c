"""The initial value of `M y' = f`: corrected, checked, or trusted, as for a manifold."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import FloatScalar, Y
from .._constraint.diagnosis import Diagnosis
from .._rosenbrock import AbstractMassMatrixSolver, MassMatrixTerm
from .._rosenbrock.algebraic import faults_of_start, INCONSISTENT, is_small
from .setup import Consistent, ProblemData, Setup


def consistent_with_mass(setup: Setup, data: ProblemData) -> tuple[Y, FloatScalar | None]:
    """Return the state to start from, and how far it was moved (`None` without a mass matrix). With
    `throw` the error that names the cause is attached to the state; otherwise the first step fails."""
    terms, (t0, _, y0, args) = setup.terms, data
    if not isinstance(terms, MassMatrixTerm) or setup.consistent == "assume":
        return y0, None
    start, info = terms.consistent_state(t0, y0, args, throw=False)
    success, correction = info.success, info.correction
    cause, messages = faults_of_start(info)
    if setup.consistent == "check":
        success = info.success & is_small(correction)
        cause = jnp.where(info.success, INCONSISTENT, cause)
        start, correction = y0, jnp.zeros_like(correction)
    if setup.throw:
        start = Diagnosis(cause, messages).raise_unless(success, start, "y0")
    return start, correction


def trusting(solver: Any, consistent: Consistent) -> Any:
    """Return the solver without its own check of the start, if that is to be trusted."""
    takes_masses = lambda x: isinstance(x, AbstractMassMatrixSolver)
    if consistent != "assume":
        return solver
    return jtu.tree_map(
        lambda s: dataclasses.replace(s, checks_start=False) if takes_masses(s) else s,
        solver,
        is_leaf=takes_masses,
    )
