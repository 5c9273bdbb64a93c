"""Comparison of all ways to compute a gradient."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from ..._adjoint import StepReplayAdjoint
from ..compare.approaches import Approach
from ..compare.task import compiled, median_ms, Task
from .case import Case, differences


# Reverse mode, except for the first one, with which all are compared.
ADJOINTS: dict[str, dfx.AbstractAdjoint] = {
    "forward": dfx.ForwardMode(),
    "checkpointed": dfx.RecursiveCheckpointAdjoint(),
    "replay": StepReplayAdjoint(),
    "direct": dfx.DirectAdjoint(),
    "backsolve": dfx.BacksolveAdjoint(),
}
# The adjoint that has to be refused: its gradient would be wrong through corrections.
REFUSED = "backsolve"
# Diffrax's default, which cannot always be differentiated forwards once more.
ONCE = "checkpointed"


@dataclasses.dataclass(frozen=True)
class Check:
    """One way to the gradient: its difference from forward mode (relative, largest component), and its
    cost. `refused` is the message of an adjoint that was refused.

    - `difference`: of the gradient.
    - `batch`: of `vmap` of the gradient, for two sets of parameters.
    - `hessian`: of a Hessian-vector product, from forward over forward mode; `None` if it was
        not asked for.
    - `memory`: temporary bytes of the compiled gradient.
    """

    adjoint: str
    difference: float | None = None
    batch: float | None = None
    hessian: float | Literal["refused"] | None = None
    run_ms: float | None = None
    compile_s: float | None = None
    memory: int | None = None
    refused: str | None = None


@dataclasses.dataclass(frozen=True)
class Combination:
    """An approach and a solver.

    - `differences`: of finite differences from forward mode, both with the same steps.
    - `exact`: of the gradient of the exact solution from forward mode, `None` if not known.
    - `tangency`: the largest derivative of the residual at the end, relative to that of the state.
    - `failure`: the reason why there is nothing to compare.
    """

    approach: str
    solver: str
    steps: int = 0
    differences: float | None = None
    exact: float | None = None
    tangency: float | None = None
    checks: tuple[Check, ...] = ()
    failure: str | None = None


class _Forward(NamedTuple):
    """The results of forward mode.

    - `parameters`: several sets, of which the first is that of the problem.
    - `gradients`: for each of them.
    - `direction`, `curvature`: the Hessian times a vector, for the first, if asked for.
    """

    parameters: Any
    gradients: list[np.ndarray]
    direction: Any
    curvature: np.ndarray | None


def combinations(
    task: Task,
    approaches: Iterable[Approach],
    solvers: Iterable[dfx.AbstractSolver],
    adjoints: dict[str, dfx.AbstractAdjoint],
    hessian: bool,
) -> Iterator[tuple[str, Combination | None]]:
    """Yield the name of each comparison with `None`, and then with its result."""
    solvers = list(solvers)
    for approach in approaches:
        for solver in solvers:
            names = approach.name, type(solver).__name__
            yield ", ".join(names), None
            try:
                case = Case.build(task.problem, approach, solver, task.gain, task.t1, task.rtol)
                yield ", ".join(names), certify(case, adjoints, hessian)
            except RuntimeError as error:
                yield ", ".join(names), Combination(*names, failure=str(error))


def certify(case: Case, adjoints: dict[str, dfx.AbstractAdjoint], hessian: bool) -> Combination:
    """Compare the gradients of one approach and solver."""
    if not case.is_corrected:  # forward mode is then Diffrax's own approximation, of another kind
        adjoints = {name: a for name, a in adjoints.items() if name != REFUSED}
    parameters = jnp.stack([case.theta, 1.001 * case.theta])
    outcome = jax.jit(
        jax.jacfwd(lambda theta: case.outcome(theta, ADJOINTS["forward"], case.adaptive))
    )
    (_, states, residuals), _ = outcomes = [outcome(theta) for theta in parameters]
    gradients = [np.asarray(gradient) for gradient, *_ in outcomes]
    direction = jnp.cos(2 + jnp.arange(case.theta.size, dtype=case.theta.dtype)) * case.theta
    curvature = None
    if hessian:
        by_forward = _gradient(case, "forward", ADJOINTS["forward"])
        curvature = np.asarray(_along(by_forward, direction)(case.theta))
    forward = _Forward(parameters, gradients, direction, curvature)
    exact = case.exact_gradient()
    return Combination(
        case.approach.name,
        type(case.adaptive.solver).__name__,
        case.frozen.max_steps,
        _by_differences(case),
        None if exact is None else _relative(exact, gradients[0]),
        float(jnp.max(jnp.abs(residuals)) / jnp.max(jnp.abs(states))),
        tuple(_check(case, name, adjoint, forward) for name, adjoint in adjoints.items()),
    )


def _by_differences(case: Case) -> float:
    """Return the difference of finite differences from forward mode, with the same steps."""

    @jax.jit
    def value_and_gradient(theta):
        value = lambda x: 2 * (case.objective(x, ADJOINTS["forward"], case.frozen),)
        gradient, value = jax.jacfwd(value, has_aux=True)(theta)
        return value, gradient

    value = lambda theta: float(value_and_gradient(jnp.asarray(theta))[0])
    gradient = np.asarray(value_and_gradient(case.theta)[1])
    return _relative(differences(value, np.asarray(case.theta)), gradient)


def _check(case: Case, name: str, adjoint: dfx.AbstractAdjoint, forward: _Forward) -> Check:
    theta = case.theta
    gradient = jax.jit(_gradient(case, name, adjoint))
    try:
        program, compile_s = compiled(gradient, theta)
    except (ValueError, TypeError, RuntimeError) as error:
        return Check(name, refused=str(error).strip().splitlines()[0])
    analysis = program.memory_analysis()
    batch = np.asarray(jax.jit(jax.vmap(gradient))(forward.parameters))
    return Check(
        name,
        difference=_relative(np.asarray(program(theta)), forward.gradients[0]),
        batch=float(np.max([*map(_relative, batch, forward.gradients)])),
        hessian=_hessian_difference(gradient, theta, forward),
        run_ms=median_ms(lambda: jax.block_until_ready(program(theta))),
        compile_s=compile_s,
        memory=None if analysis is None else int(analysis.temp_size_in_bytes),
    )


def _hessian_difference(
    gradient: Callable[[Any], Any], theta: Any, forward: _Forward
) -> float | Literal["refused"] | None:
    if forward.curvature is None:
        return None
    try:
        found = _along(gradient, forward.direction)(theta)
    except (TypeError, ValueError):  # raised by JAX or Equinox: cannot be differentiated forwards
        return "refused"
    return _relative(np.asarray(found), forward.curvature)


def _gradient(case: Case, name: str, adjoint: dfx.AbstractAdjoint) -> Callable[[Any], Any]:
    """Return the gradient as users compute it: the steps are chosen anew."""
    transform = jax.jacfwd if name == "forward" else jax.grad
    return transform(lambda theta: case.objective(theta, adjoint, case.adaptive))


def _along(gradient: Callable[[Any], Any], direction: Any) -> Callable[[Any], Any]:
    """Return the Hessian times `direction`."""
    return jax.jit(lambda theta: jax.jvp(gradient, (theta,), (direction,))[1])


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))
