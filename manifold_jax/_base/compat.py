"""The only file that touches private names of Diffrax and Equinox.

Seen in Diffrax 0.7.2 and Equinox 0.13.8; each name has a test that fails when it moves.
"""

import types
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import AbstractTerm, MultiTerm, RESULTS
from diffrax._heuristics import (
    is_sde as is_sde,  # whether terms are driven by Brownian motion
    is_unsafe_sde as is_unsafe_sde,  # whether by one that cannot be evaluated twice
)
from diffrax._integrate import (
    loop as _loop,  # the loop that an adjoint runs
    SaveState as SaveState,  # what has been saved so far
    State as LoopState,  # what a solve carries from step to step
)
from diffrax._root_finder import (
    use_stepsize_tol as use_stepsize_tol,  # marks tolerances that are to be those of the steps
)
from diffrax._saveat import save_y as save_y  # marks "save the state itself" in SubSaveAt.fn
from diffrax._solution import (
    is_okay as is_okay,  # successful or stopped by an event
    update_result as update_result,  # first failure wins
)
from diffrax._term import WrapTerm
from equinox.internal import (
    buffer_at_set as buffer_at_set,  # writes in place, also under vmap
    MaybeBuffer as MaybeBuffer,  # an array, or one that a loop writes to in place
    nondifferentiable as nondifferentiable,
    nondifferentiable_backward as nondifferentiable_backward,
    unvmap_any as unvmap_any,  # over all lanes of a batch
    unvmap_max as unvmap_max,
    while_loop as while_loop,  # Diffrax's loops take its arguments
)
from jaxtyping import PyTree

from .types import RealScalarLike


def _with_names(function: Callable, **names: Any) -> Callable:
    """Return a function that finds other values under some of the names of its module."""
    module = {**function.__globals__, **names}
    copy = types.FunctionType(
        function.__code__, module, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _clip_to_end(tprev: Any, tnext: Any, t1: Any, _: Any, keep_step: Any) -> Any:
    """Return the end of the next step: `t1` if it is less than 100 units of rounding before it or later.

    Diffrax finds that threshold by a hundred calls of `prevbefore`, one after the other: 1700 operations, for which
    XLA takes 0.3 seconds in every program.
    """
    threshold = t1 - 100 * (t1 - eqxi.prevbefore(t1))
    end = jnp.where(keep_step, t1, tprev + 0.5 * (t1 - tprev))
    return jnp.where(tnext > threshold, end, tnext)


# The loop that an adjoint runs.
diffrax_loop = _with_names(
    _loop,
    eqxi=types.SimpleNamespace(**{**vars(eqxi), "prevbefore": lambda t: t}),
    _clip_to_end=_clip_to_end,
)


def time_direction(terms: PyTree) -> RealScalarLike:
    """`1` or `-1`: Diffrax integrates `t1 < t0` in negated time and says so only here.

    A solver's `step` sees the negated times; the true time is `t * time_direction(terms)`.
    Terms that were never wrapped (manual stepping) run in true time.
    """
    leaves = jtu.tree_leaves(terms, is_leaf=lambda x: isinstance(x, WrapTerm))
    for leaf in leaves:
        if isinstance(leaf, WrapTerm):
            return leaf.direction
    return 1


def directed(terms: PyTree, direction: RealScalarLike) -> PyTree:
    """Return the terms in the time in which Diffrax integrates, `t * direction`."""
    is_leaf = lambda x: isinstance(x, AbstractTerm) and not isinstance(x, MultiTerm)
    return jtu.tree_map(lambda term: WrapTerm(term, direction), terms, is_leaf=is_leaf)  # pyright: ignore[reportArgumentType]


def undirected(terms: PyTree) -> PyTree:
    """Return the terms as the user wrote them, without the wrapper for negated time."""
    return terms.term if isinstance(terms, WrapTerm) else terms


def nonlinear_failure() -> RESULTS:
    """Return the result code for a constraint that could not be satisfied.

    Result codes cannot be added from outside Diffrax; this is the one that its implicit solvers
    return when their equations cannot be solved.
    """
    return RESULTS.nonlinear_divergence  # pyright: ignore[reportReturnType]


def number_of_result(result: RESULTS) -> Any:
    """Return the number by which a result code is stored."""
    return result._value  # pyright: ignore


def messages_of_results() -> list[str]:
    """Return the messages of all result codes, by number."""
    return list(RESULTS._index_to_message)  # pyright: ignore


def save_states(state: LoopState) -> list[SaveState]:
    """Return what a solve has saved so far, one state per `SubSaveAt`."""
    is_save_state = lambda x: isinstance(x, SaveState)
    leaves = jtu.tree_leaves(state.save_state, is_leaf=is_save_state)
    return [leaf for leaf in leaves if is_save_state(leaf)]


def with_result(state: LoopState, result: RESULTS) -> LoopState:
    """Return the state of a solve that ends with this result before its next step, if it is a failure."""
    return eqx.tree_at(lambda s: s.result, state, update_result(state.result, result))


def start_of_last(state: LoopState) -> Any:
    """Return where the last step began, which is known with events only."""
    return state.event_tprev


def with_resets_put(state: LoopState, controller_state: Any, start_of_last: Any) -> LoopState:
    parts = lambda s: (s.controller_state, s.event_tprev)
    new = controller_state, start_of_last
    return eqx.tree_at(parts, state, new, is_leaf=lambda x: x is None)


def with_next_time(state: LoopState, tnext: Any) -> LoopState:
    """Return the state of a solve whose next step ends at `tnext`."""
    return eqx.tree_at(lambda s: s.tnext, state, tnext)


def with_controller_state(state: LoopState, controller_state: Any) -> LoopState:
    is_leaf = lambda x: x is None
    return eqx.tree_at(lambda s: s.controller_state, state, controller_state, is_leaf=is_leaf)


class Progress(NamedTuple):
    """The progress of a solve: where its next step begins and ends, from which state, and the
    numbers of steps so far."""

    tprev: Any
    tnext: Any
    made_jump: Any
    y: Any
    solver_state: Any
    controller_state: Any
    num_steps: Any
    num_accepted_steps: Any

    @staticmethod
    def of(state: LoopState) -> "Progress":
        return Progress(*(getattr(state, name) for name in Progress._fields))


class Ending(NamedTuple):
    """The end of a solve."""

    event_mask: Any
    save_state: Any
    result: RESULTS

    @staticmethod
    def of(state: LoopState) -> "Ending":
        return Ending(state.event_mask, state.save_state, state.result)

    def put_into(self, state: LoopState) -> LoopState:
        return eqx.tree_at(lambda s: (s.event_mask, s.save_state, s.result), state, tuple(self))


class LastStep(NamedTuple):
    """The step in which an event happened, and the values of the conditions after it."""

    start: Any
    end: Any
    dense_info: Any
    values: Any
    mask: Any

    @staticmethod
    def of(state: LoopState) -> "LastStep":
        times = state.event_tprev, state.event_tnext
        return LastStep(*times, state.event_dense_info, state.event_values, state.event_mask)


class Differentiable(NamedTuple):
    """The differentiable part of the final state of a loop: no statistics, no controller state."""

    ts: list[Any]
    ys: list[Any]
    dense_ts: Any
    dense_infos: Any
    event_dense_info: Any
    y: Any
    solver_state: Any
    resets: Any = None  # not a part of Diffrax's state

    @staticmethod
    def of(state: LoopState) -> "Differentiable":
        saved = save_states(state)
        dense = state.dense_ts, state.dense_infos, state.event_dense_info
        rows = [s.ts for s in saved], [s.ys for s in saved]
        return Differentiable(*rows, *dense, state.y, state.solver_state)

    def put_into(self, state: LoopState) -> LoopState:
        replaced = lambda where, tree, new: eqx.tree_at(
            where, tree, new, is_leaf=lambda x: x is None
        )
        rows = zip(save_states(state), self.ts, self.ys, strict=True)
        saved = [replaced(lambda s: (s.ts, s.ys), s, new) for s, *new in rows]
        parts = lambda s: (s.dense_ts, s.dense_infos, s.event_dense_info, s.y, s.solver_state)
        return replaced(parts, eqx.tree_at(save_states, state, saved), self[2:7])


def scan_counts(equation: Any) -> tuple[int, int]:
    """Return the numbers of constants and of carried values among the inputs of a traced `lax.scan`.
    JAX 0.12 has no parameters for them; scanned arrays have one axis less in the body."""
    body = getattr(equation.params["jaxpr"], "jaxpr", equation.params["jaxpr"])
    scanned = lambda outer, inner: sum(
        a.aval.ndim > b.aval.ndim for a, b in zip(outer, inner, strict=True)
    )
    num_carry = len(equation.outvars) - scanned(equation.outvars, body.outvars)
    num_scanned = scanned(equation.invars, body.invars)
    return len(equation.invars) - num_carry - num_scanned, num_carry
