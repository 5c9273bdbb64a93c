"""The loops around optimizers: history, progress, early stop."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from .objective import gaps, Objective, residuals, solve, Solved, total_loss


class Options(NamedTuple):
    """How long to go on, and who watches."""

    steps: int
    patience: int
    batch_size: int | None
    seed: int
    progress: bool


class Outcome(NamedTuple):
    """The unknowns, all pieces there, the loss of each step, and how it ended."""

    u: Any
    solved: Solved
    losses: list[float]
    success: bool
    message: str


class _Meter:
    """A progress bar with the loss, or nothing."""

    def __init__(self, options: Options):
        columns = TextColumn("fit"), BarColumn(), TextColumn("{task.fields[loss]}")
        self.bar = Progress(*columns, TimeElapsedColumn(), disable=not options.progress)
        self.task = self.bar.add_task("fit", total=options.steps, loss="")

    def advance(self, loss: float) -> None:
        self.bar.update(self.task, advance=1, loss=f"loss {loss:.6g}")


def look(u: Any, objective: Objective, optimizer: Any) -> Solved:
    """All pieces at one point, by the program that takes steps if it can tell: compiling takes
    longer than solving."""
    if isinstance(optimizer, optax.GradientTransformation):
        return _solve(u, objective)
    state = _initialize(optimizer, u, objective)
    return _advance(optimizer, u, objective, state)[2][1]


_solve = eqx.filter_jit(solve)


def optimize(objective: Objective, u: Any, optimizer: Any, options: Options) -> Outcome:
    if isinstance(optimizer, optax.GradientTransformation):
        return _with_optax(objective, u, optimizer, options)
    if objective.joints.size == 0:
        return _with_optimistix(objective, u, optimizer, options)
    return _closing_gaps(objective, u, optimizer, options)


def _with_optimistix(objective: Objective, u: Any, solver: Any, options: Options) -> Outcome:
    """Step by step through the public methods of the solver, which return what was seen at the
    point from which they step."""
    state, losses, meter = _initialize(solver, u, objective), [], _Meter(options)
    done, okay = False, True
    with meter.bar:
        while True:
            new, state, (loss, solved), new_done, new_okay = _advance(solver, u, objective, state)
            losses.append(float(loss))
            meter.advance(losses[-1])
            if done or not okay or len(losses) > options.steps:
                break
            if _stalled(losses, options.patience):
                done = True
                break
            u, done, okay = new, bool(new_done), bool(new_okay)
    message = "converged" if done else f"not converged after {options.steps} steps"
    message = message if okay else "a linear solve of the optimizer failed"
    return Outcome(u, solved, losses, done and okay, message)


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


def _stalled(losses: list[float], patience: int) -> bool:
    """Whether `patience` steps have not lowered the loss by more than rounding."""
    if len(losses) <= patience + 1:
        return False
    return min(losses[-patience:]) > min(losses[:-patience]) * (1 - 1e-9)


def _closing_gaps(objective: Objective, u: Any, solver: Any, options: Options) -> Outcome:
    """Multiple shooting: the states at the joints meet in the limit.

    An augmented Lagrangian, `sum r^2 + w^2 sum (c + s)^2`: after each fit `s` grows by the gaps
    that are left, and `w` by ten. Source: Nocedal & Wright, Numerical Optimization, ch. 17.
    """
    losses = []
    for _ in range(12):
        found = _with_optimistix(objective, u, solver, options)
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
    return found._replace(losses=losses, success=False, message=message)


def _with_optax(objective: Objective, u: Any, optimizer: Any, options: Options) -> Outcome:
    """Epochs of one batch each, or of a random order of all records cut into batches."""
    records, size = objective.pieces.start.size, options.batch_size
    random, meter = np.random.default_rng(options.seed), _Meter(options)
    optimizer = optax.with_extra_args_support(optimizer)
    state, losses, best = optimizer.init(u), [], (np.inf, u)
    message = f"all {options.steps} steps taken"
    with meter.bar:
        for _ in range(options.steps):
            batches = [None]
            if size is not None:
                batches = np.resize(random.permutation(records), (-(-records // size), size))
            begin, total = u, 0.0
            for batch in batches:
                batch = None if batch is None else jnp.asarray(batch)
                u, state, loss = _descend(optimizer, u, state, objective, batch)
                total += float(loss) / len(batches)
            losses.append(total)
            meter.advance(total)
            best = min(best, (total, begin if size is None else u), key=lambda pair: pair[0])
            if _stalled(losses, options.patience):
                message = "the loss decreases no more"
                break
    return Outcome(best[1], _solve(best[1], objective), losses, True, message)


@eqx.filter_jit
def _descend(optimizer: Any, u: Any, state: Any, objective: Objective, batch: Any) -> Any:
    function = lambda u: total_loss(u, objective, batch)
    (loss, _), slope = jax.value_and_grad(function, has_aux=True)(u)
    with jax.numpy_dtype_promotion("standard"):
        updates, state = optimizer.update(
            slope, state, u, value=loss, grad=slope, value_fn=lambda u: function(u)[0]
        )
        return optax.apply_updates(u, updates), state, loss
