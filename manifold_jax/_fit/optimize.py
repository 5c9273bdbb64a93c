"""The loops around optimizers: history, early stopping, parameters at bounds."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx

from .bounds import BESIDE, driven, linear_step, on_bounds, put_beside_bounds, put_on_bounds
from .convergence import at_minimum, flat, stalled
from .objective import gaps, Objective, residuals, Solved, total_loss
from .progress import FitMeter


class Options(NamedTuple):
    """The optimizer, its limits, the order of records, and the progress meter."""

    optimizer: Any
    steps: int
    patience: int
    batch_size: int | None
    seed: int
    starts: int
    meter: FitMeter

    @property
    def by_gradient(self) -> bool:
        return isinstance(self.optimizer, optax.GradientTransformation)


class OptimizerOutcome(NamedTuple):
    """The final unknowns, all pieces and the loss there, the loss of each step, and the message."""

    u: Any
    solved: Solved
    losses: list[float]
    loss: float
    success: bool
    message: str


def look(u: Any, objective: Objective, options: Options) -> tuple[Any, Solved]:
    """Return the loss and all pieces at one point, by the program that takes steps if that returns
    them: compiling takes longer than solving."""
    if options.by_gradient:
        return _loss(u, objective)[1]
    state = _initialize(options.optimizer, u, objective)
    return _advance(options.optimizer, u, objective, state)[2]


_loss = eqx.filter_jit(total_loss)


def optimize(objective: Objective, u: Any, options: Options) -> OptimizerOutcome:
    if options.by_gradient:
        return _with_optax(objective, u, options)
    if objective.joints.size == 0:
        return _within_bounds(objective, u, options)
    return _closing_gaps(objective, u, options)


def _within_bounds(objective: Objective, u: Any, options: Options) -> OptimizerOutcome:
    """Optimize with bounds. Each parameter is put on a bound at most once, and at most once taken off
    again, if it belongs inside after the others have moved."""
    transform = objective.transform
    losses, movable = [], np.ones(transform.start.size, bool)
    returning, before = movable.copy(), None
    while True:
        found = _with_optimistix(objective, u, options, losses, movable)
        # On the bound the loss may be larger until the others have moved.
        if before is not None and not found.loss <= before.loss:
            u, before = before.u, None
            continue
        side = driven(found.u, found.solved, objective) * movable
        if np.any(side):
            movable &= side == 0
            u, before = put_on_bounds(found.u, side), found
            continue
        side = on_bounds(found.u, transform)
        if not found.success or not np.any(side):
            return found
        beside = put_beside_bounds(found.u, side, BESIDE, transform)
        step = linear_step(beside, look(beside, objective, options)[1], objective)
        # of the current distances, those at which the linearized problem is solved
        left = 1 - side * step[: side.size]
        inside = (side != 0) & (left > 2) & returning
        if not np.any(inside):
            return found
        returning &= ~inside
        left = np.clip(BESIDE * left, BESIDE, 0.1)
        u = put_beside_bounds(found.u, side * inside, left, transform)


def _with_optimistix(
    objective: Objective, u: Any, options: Options, losses: list[float], movable: np.ndarray
) -> OptimizerOutcome:
    """Optimize step by step through the public methods of the solver, which return the values at the
    point from which they step. End early if a `movable` parameter is driven to a bound."""
    solver, done, okay, message = options.optimizer, False, True, None
    state = _initialize(solver, u, objective)
    while message is None:
        new, state, (loss, solved), new_done, new_okay = _advance(solver, u, objective, state)
        losses.append(float(loss))
        options.meter.advance(losses[-1])
        if not okay:
            message = "a linear solve of the optimizer failed"
        elif done or stalled(losses, options.patience):
            message = "converged"
        elif len(losses) > options.steps:
            message = f"not converged after {options.steps} steps"
        elif flat(losses) and np.any(driven(u, solved, objective) * movable):
            message = "driven to a bound"
        elif at_minimum(losses, u, solved, objective, solver):
            message = "converged"
        else:
            u, done, okay = new, bool(new_done), bool(new_okay)
    return OptimizerOutcome(u, solved, losses, losses[-1], message == "converged", message)


def _function_for(solver: Any) -> Callable:
    return residuals if isinstance(solver, optx.AbstractLeastSquaresSolver) else total_loss


@eqx.filter_jit
def _initialize(solver: Any, u: Any, objective: Objective) -> Any:
    function = _function_for(solver)
    structs = eqx.filter_eval_shape(function, u, objective)
    return solver.init(function, u, objective, {}, *structs, frozenset())


@eqx.filter_jit
def _advance(solver: Any, u: Any, objective: Objective, state: Any) -> Any:
    function = _function_for(solver)
    with jax.numpy_dtype_promotion("standard"):
        u, state, seen = solver.step(function, u, objective, {}, state, frozenset())
        done, result = solver.terminate(function, u, objective, {}, state, frozenset())
    return u, state, seen, done, result == optx.RESULTS.successful


def _closing_gaps(objective: Objective, u: Any, options: Options) -> OptimizerOutcome:
    """Multiple shooting: close the gaps at the joints, which vanish in the limit.

    An augmented Lagrangian, `sum r^2 + w^2 sum (c + s)^2`: after each fit `s` grows by the gaps that
    are left, and `w` by ten. Source: Nocedal & Wright, Numerical Optimization, ch. 17.
    """
    losses = []
    for _ in range(12):
        found = _within_bounds(objective, u, options)
        u, losses = found.u, losses + found.losses
        gap = gaps(objective, found.solved.values)
        size = float(jnp.max(jnp.abs(gap)))
        if size <= 1e-8 * float(jnp.max(jnp.abs(objective.pieces.guess))):
            return found._replace(losses=losses)
        objective = eqx.tree_at(
            lambda o: (o.shift, o.stiffness),
            objective,
            ((objective.shift + gap) / 100, objective.stiffness * 10),
        )
    message = f"gaps of {size:.1e} are left between segments; take shorter ones"
    # Not comparable with other starts: it is the loss of no trajectory.
    return found._replace(losses=losses, loss=np.inf, success=False, message=message)


def _with_optax(objective: Objective, u: Any, options: Options) -> OptimizerOutcome:
    """Take epochs of one batch each, or of a random order of all records cut into batches."""
    records, size = objective.pieces.start.size, options.batch_size
    random = np.random.default_rng(options.seed)
    optimizer = optax.with_extra_args_support(options.optimizer)
    state, losses, best = optimizer.init(u), [], (np.inf, u)
    message = f"all {options.steps} steps taken"
    for _ in range(options.steps):
        batches = [None]
        if size is not None:
            batches = np.resize(random.permutation(records), (-(-records // size), size))
        begin, total = u, 0.0
        for batch in batches:
            batch = None if batch is None else jnp.asarray(batch)
            with options.meter.compiling("a step"):
                u, state, loss = _descend(optimizer, u, state, objective, batch)
            total += float(loss) / len(batches)
        losses.append(total)
        options.meter.advance(total)
        best = min(best, (total, begin if size is None else u), key=lambda pair: pair[0])
        if stalled(losses, options.patience):
            message = "the loss decreases no more"
            break
    solved = look(best[1], objective, options)[1]
    return OptimizerOutcome(best[1], solved, losses, best[0], True, message)


@eqx.filter_jit
def _descend(optimizer: Any, u: Any, state: Any, objective: Objective, batch: Any) -> Any:
    function = lambda u: total_loss(u, objective, batch)
    (loss, _), slope = jax.value_and_grad(function, has_aux=True)(u)
    with jax.numpy_dtype_promotion("standard"):
        updates, state = optimizer.update(
            slope, state, u, value=loss, grad=slope, value_fn=lambda u: function(u)[0]
        )
        return optax.apply_updates(u, updates), state, loss
