"""All ways to a gradient, compared."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from .._adjoint import StepReplayAdjoint
from .._compare.approaches import Approach
from .._compare.task import Task
from .._compare.timing import median_ms
from .case import Case, differences


# Reverse mode, except for the first one, with which all are compared.
ADJOINTS: dict[str, dfx.AbstractAdjoint] = {
    "forward": dfx.ForwardMode(),
    "checkpointed": dfx.RecursiveCheckpointAdjoint(),
    "replay": StepReplayAdjoint(),
    "direct": dfx.DirectAdjoint(),
    "backsolve": dfx.BacksolveAdjoint(),
}
# The one that has to be refused: its gradient would be wrong through corrections.
REFUSED = "backsolve"
# Diffrax's own, which cannot always be differentiated forwards once more.
ONCE = "checkpointed"


@dataclasses.dataclass(frozen=True)
class Check:
    """One way to the gradient: how far it is from forward mode (relative, largest component),
    and what it cost. `refused` is the message of an adjoint that was refused, instead.

    - `hessian`: of a Hessian-vector product, from forward over forward mode; `None` if it was
        refused.
    - `batch`: of `vmap(grad)` from one at a time.
    - `memory`: temporary bytes of the compiled gradient.
    """

    adjoint: str
    difference: float | None = None
    hessian: float | None = None
    batch: float | None = None
    run_ms: float | None = None
    compile_s: float | None = None
    memory: int | None = None
    refused: str | None = None


@dataclasses.dataclass(frozen=True)
class Combination:
    """An approach and a solver.

    - `value_ms`: time of the solve alone.
    - `differences`: of finite differences from forward mode.
    - `exact`: of the gradient of the exact solution from forward mode, `None` if not known.
    - `tangency`: the largest derivative of the residual at the end, relative to that of the
        state.
    - `failure`: why there is nothing to compare.
    """

    approach: str
    solver: str
    steps: int = 0
    value_ms: float | None = None
    differences: float | None = None
    exact: float | None = None
    tangency: float | None = None
    checks: tuple[Check, ...] = ()
    failure: str | None = None


def combinations(
    task: Task,
    approaches: Iterable[Approach],
    solvers: Iterable[dfx.AbstractSolver],
    adjoints: dict[str, dfx.AbstractAdjoint],
) -> Iterator[tuple[str, Combination | None]]:
    """What is being compared, and the result once it is known, in turn."""
    solvers = list(solvers)
    for approach in approaches:
        for solver in solvers:
            solver_name = type(solver).__name__
            yield f"{approach.name}, {solver_name}", None
            if approach.needs_system and task.problem.system is None:
                failure = "needs a mechanical system"
            else:
                try:
                    case = Case.build(task.problem, approach, solver, task.gain, task.t1, task.rtol)
                    yield f"{approach.name}, {solver_name}", certify(case, adjoints)
                    continue
                except RuntimeError as error:
                    failure = str(error)
            yield "", Combination(approach.name, solver_name, failure=failure)


def certify(case: Case, adjoints: dict[str, dfx.AbstractAdjoint]) -> Combination:
    """Compare the gradients of one approach and solver."""
    theta = case.theta
    if not case.is_corrected:  # then it is Diffrax's own approximation, of another kind
        adjoints = {name: a for name, a in adjoints.items() if name != REFUSED}
    forward = _gradient(case, "forward", ADJOINTS["forward"])
    reference = np.asarray(jax.jit(forward)(theta))
    direction = jnp.cos(2 + jnp.arange(theta.size, dtype=theta.dtype)) * theta
    curvature = np.asarray(_along(forward, direction)(theta))
    value = jax.jit(case.objective(dfx.RecursiveCheckpointAdjoint()))
    by_differences = differences(lambda x: float(value(jnp.asarray(x))), np.asarray(theta))
    exact = case.exact_gradient()
    tangents = jax.jit(jax.jacfwd(lambda x: case.residual(x, dfx.ForwardMode())))(theta)
    states = jax.jit(jax.jacfwd(lambda x: case.end(x, dfx.ForwardMode())))(theta)
    return Combination(
        case.approach.name,
        type(case.solver).__name__,
        len(case.steps) - 1,
        median_ms(lambda: jax.block_until_ready(value(theta))),
        _relative(by_differences, reference),
        None if exact is None else _relative(exact, reference),
        float(jnp.max(jnp.abs(tangents)) / jnp.max(jnp.abs(states))),
        tuple(
            _check(case, name, adjoint, reference, direction, curvature)
            for name, adjoint in adjoints.items()
        ),
    )


def _check(
    case: Case,
    name: str,
    adjoint: dfx.AbstractAdjoint,
    reference: np.ndarray,
    direction: Any,
    curvature: np.ndarray,
) -> Check:
    theta = case.theta
    gradient = jax.jit(_gradient(case, name, adjoint))
    start = time.perf_counter()
    try:
        compiled = gradient.lower(theta).compile()
    except (ValueError, TypeError, NotImplementedError) as error:
        return Check(name, refused=str(error).strip().splitlines()[0])
    compile_s = time.perf_counter() - start
    analysis = compiled.memory_analysis()
    several = jnp.stack([theta, 1.001 * theta, 0.999 * theta])
    batch = jax.jit(jax.vmap(gradient))(several)
    return Check(
        name,
        difference=_relative(np.asarray(compiled(theta)), reference),
        hessian=_hessian_difference(gradient, theta, direction, curvature),
        batch=max(
            _relative(np.asarray(b), np.asarray(gradient(x)))
            for b, x in zip(batch, several, strict=True)
        ),
        run_ms=median_ms(lambda: jax.block_until_ready(compiled(theta))),
        compile_s=compile_s,
        memory=None if analysis is None else int(analysis.temp_size_in_bytes),
    )


def _hessian_difference(
    gradient: Callable[[Any], Any], theta: Any, direction: Any, curvature: np.ndarray
) -> float | None:
    try:
        found = _along(gradient, direction)(theta)
    except (TypeError, ValueError):  # of JAX or Equinox: cannot be differentiated forwards
        return None
    return _relative(np.asarray(found), curvature)


def _gradient(case: Case, name: str, adjoint: dfx.AbstractAdjoint) -> Callable[[Any], Any]:
    transform = jax.jacfwd if name == "forward" else jax.grad
    return transform(case.objective(adjoint))


def _along(gradient: Callable[[Any], Any], direction: Any) -> Callable[[Any], Any]:
    """The Hessian times `direction`."""
    return jax.jit(lambda theta: jax.jvp(gradient, (theta,), (direction,))[1])


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))
