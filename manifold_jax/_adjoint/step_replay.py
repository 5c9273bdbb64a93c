"""Reverse mode that goes back through the recorded steps, each computed once more."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._compat import (
    diffrax_loop,
    is_unsafe_sde,
    nondifferentiable,
    nondifferentiable_backward,
    save_states,
    while_loop,
)
from .record import default_stride, Record, recording
from .replay import Replay, replay_backwards, Rows


class StepReplayAdjoint(dfx.AbstractAdjoint):
    r"""Reverse mode for small systems, `adjoint=mj.StepReplayAdjoint()`.

    The derivative of the discrete solution, as with `diffrax.RecursiveCheckpointAdjoint`:
    from the accepted steps $y_{i+1} = \Phi(t_i, t_{i+1}, y_i, \theta)$ and the gradient
    $\bar y_n$ with respect to the last state

    $$\bar y_i = (\partial\Phi/\partial y_i)^T \bar y_{i+1} + (\partial s_i/\partial y_i)^T \bar s_i, \qquad
      \bar\theta = \sum_i (\partial\Phi/\partial\theta)^T \bar y_{i+1} + \dots$$

    with $s_i$ what was saved in step $i$. The solve records $(t_i, t_{i+1}, y_i)$, and the way
    back computes each step once more, where recursive checkpointing repeats large parts of
    the solve, controller and saving included. The step sizes are those that were recorded:
    rounding differently on the way back cannot change them.

    **Arguments:**

    - `checkpoints`: the largest number of states to record, by default all of them if a
        state has up to 64 bytes, and about `sqrt(max_steps)` otherwise. Every
        `ceil(max_steps / checkpoints)`-th state is kept, and those between two of them are
        computed again, one more pass over the steps altogether. Fewer save memory, and time in
        a batch where `max_steps` is much more than the number of steps. Memory: `3 max_steps`
        numbers, `checkpoints` states, and the states between two of them.

    Works with any one-step solver of Diffrax or this library, adaptive or constant steps, and
    `SaveAt` with `t0`, `t1`, `ts`, `steps` and `fn`. Derivatives with respect to `y0`,
    `args`, and all that terms, constraints and `fn` hold or close over. Under `vmap` all
    trajectories go back with one common counter.

    **Raises:**

    `ValueError` for what it does not support: events, `max_steps=None`, `UnsafeBrownianPath`,
    solvers with a memory (`LeapfrogMidpoint`, `ReversibleHeun`; your own cannot be told), `ts`
    and `steps` in one `SubSaveAt`. An error when differentiating with respect to times
    (`t0`, `t1`, `dt0`, `ts`) or through the dense solution. Use
    `diffrax.RecursiveCheckpointAdjoint()` there, which is also the better choice where a
    state is so large that `max_steps` of them do not fit into memory, and under `vmap` with
    thousands of parameters in common (neural networks: each trajectory sums up a gradient
    of its own); for few parameters and many outputs use `diffrax.ForwardMode()`.

    Source: Griewank & Walther, Evaluating Derivatives (2008), ch. 12, without recursion.
    """

    checkpoints: int | None = None

    def __check_init__(self):
        if self.checkpoints is not None and self.checkpoints < 1:
            raise ValueError(
                f"`checkpoints` must be a positive integer, got {self.checkpoints!r}: the number of states to record."
            )

    def loop(
        self,
        *,
        args,
        terms,
        solver,
        stepsize_controller,
        saveat,
        t0,
        t1,
        dt0,
        max_steps,
        event,
        init_state,
        throw,
        passed_solver_state,
        passed_controller_state,
        progress_meter,
    ) -> Any:
        del throw, passed_solver_state, passed_controller_state
        _check_supported(terms, solver, saveat, event, max_steps)
        solver = _twice_differentiable(solver)
        fixed = (t0, t1, dt0, stepsize_controller, init_state.tprev, init_state.tnext)
        t0, t1, dt0, stepsize_controller, tprev, tnext = _without_derivative(fixed)
        saveat = eqx.tree_at(_saved_times, saveat, replace_fn=_without_derivative)
        init_state = eqx.tree_at(lambda s: (s.tprev, s.tnext), init_state, (tprev, tnext))
        y0 = init_state.y
        checkpoints = self.checkpoints
        stride = (
            default_stride(y0, max_steps) if checkpoints is None else -(-max_steps // checkpoints)
        )
        record = Record.empty(y0, tprev.dtype, max_steps, stride)

        def forward(record):
            run = lambda outer: diffrax_loop(
                solver=solver,
                stepsize_controller=stepsize_controller,
                event=None,
                saveat=saveat,
                t0=t0,
                t1=t1,
                dt0=dt0,
                max_steps=max_steps,
                terms=terms,
                args=args,
                init_state=init_state,
                inner_while_loop=lambda *a, checkpoints, **kw: while_loop(*a, kind="lax", **kw),
                outer_while_loop=outer,
                progress_meter=progress_meter,
            )
            return recording(record, run)

        replay = Replay.build(terms, solver, args, saveat, t0, y0)
        # What the functions close over becomes their leaves, which have derivatives.
        forward = eqx.filter_closure_convert(forward, record)
        (final_state, statistics), ys = _solve((replay, y0, forward), record)
        final_state = nondifferentiable_backward(final_state, msg=_ONLY_SAVED)
        saved = save_states(final_state)
        saved = [eqx.tree_at(lambda s: s.ys, s, y) for s, y in zip(saved, ys, strict=True)]
        return eqx.tree_at(save_states, final_state, saved), statistics


_ONLY_SAVED = (
    "With `adjoint=StepReplayAdjoint()` only saved values `sol.ys` have derivatives, not the dense solution, statistics "
    "or solver states. Save with `SaveAt(ts=...)`, or use `adjoint=diffrax.RecursiveCheckpointAdjoint()`."
)


@eqx.filter_custom_vjp
def _solve(differentiable, record):
    _, _, forward = differentiable
    (final_state, statistics), _ = forward(record)
    return (final_state, statistics), [s.ys for s in save_states(final_state)]


@_solve.def_fwd
def _forward(perturbed, differentiable, record):
    del perturbed
    _, _, forward = differentiable
    (final_state, statistics), record = forward(record)
    saved = save_states(final_state)
    last = final_state.tprev, final_state.y
    counts = final_state.num_steps, final_state.num_accepted_steps
    residuals = record, counts, last, saved
    return ((final_state, statistics), [s.ys for s in saved]), residuals


@_solve.def_bwd
def _backward(residuals, cotangents, perturbed, differentiable, record):
    del record
    record, counts, last, saved = residuals
    replay, y0, forward = differentiable
    _, ys_bar = cotangents

    def rows(saved, bar):
        filled = lambda b, y: jnp.zeros_like(y) if b is None else b
        bar = jtu.tree_map(filled, bar, saved.ys, is_leaf=lambda x: x is None)
        return Rows(saved.ts, record.steps_at(saved.ts), saved.save_index, bar)

    saved = [rows(s, bar) for s, bar in zip(saved, ys_bar, strict=True)]
    replay_bar, y0_bar = replay_backwards(replay, perturbed[0], record, counts, saved, y0, last)
    return replay_bar, y0_bar, eqx.filter(forward, lambda leaf: False)


def _twice_differentiable(solver: Any) -> Any:
    """Diffrax's loop over the stages of a step is of a kind that has no derivative forwards of the
    one backwards, unless it is told otherwise (as its own `DirectAdjoint` does)."""
    if getattr(solver, "scan_kind", "none") is not None:
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, "bounded", is_leaf=lambda x: x is None)


def _saved_times(saveat: dfx.SaveAt) -> list[Any]:
    subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))
    return [sub.ts for sub in subs if sub.ts is not None]


def _without_derivative(tree: Any) -> Any:
    return nondifferentiable(tree, name="A time or step size, with `adjoint=StepReplayAdjoint()`,")


def _check_supported(
    terms: Any, solver: Any, saveat: dfx.SaveAt, event: Any, max_steps: int | None
) -> None:
    other = "use `adjoint=diffrax.RecursiveCheckpointAdjoint()`."
    if event is not None:
        raise ValueError(f"`adjoint=StepReplayAdjoint()` does not support `event`: {other}")
    if max_steps is None or max_steps < 1:
        raise ValueError(
            "`adjoint=StepReplayAdjoint()` needs room for the steps it records: pass a positive integer as `max_steps`."
        )
    inner = getattr(solver, "solver", solver)
    if isinstance(inner, dfx.LeapfrogMidpoint | dfx.ReversibleHeun):
        raise ValueError(
            f"`adjoint=StepReplayAdjoint()` repeats each step from its state alone, but `{type(inner).__name__}()` "
            f"needs what it remembers of earlier ones: {other}"
        )
    if is_unsafe_sde(terms):
        raise ValueError(
            "`adjoint=StepReplayAdjoint()` cannot repeat the steps of an `UnsafeBrownianPath`. Use a "
            "`VirtualBrownianTree`."
        )
    for sub in jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt)):
        if sub.ts is not None and sub.steps != 0:
            raise ValueError(
                "`saveat` has `ts` and `steps` together, which `adjoint=StepReplayAdjoint()` does not support. Write "
                "`SaveAt(subs=[SubSaveAt(ts=...), SubSaveAt(steps=True)])`."
            )
