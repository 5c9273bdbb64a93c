"""The derivative of the discrete solution, in reverse mode from a record of its steps."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.closure import convert_closure
from .._base.compat import (
    Differentiable,
    diffrax_loop,
    is_sde,
    is_unsafe_sde,
    nondifferentiable,
    nondifferentiable_backward,
    Progress,
    save_states,
    SaveState,
    while_loop,
)
from .._base.derivative_rule import apply_linear, ForwardRule
from .._resets.controller import state_of_resets
from .events import LocatingAdjoint
from .fixed_steps import (
    event_of_controller,
    MadeSteps,
    numbered,
    unnumbered,
    with_end_held_fixed,
    with_steps_held_fixed,
)
from .gradient import Ends, TimesBar, with_zeros
from .prescribed import prescribed_times
from .record import Record, recording
from .replay import outputs_of, Replay, Solve, State, subs_of, with_outputs
from .reverse_sweep import DenseBars, ResetBars, ReverseSweep
from .saved import Functions, Rows, SavedValues


class StepReplayAdjoint(dfx.AbstractAdjoint):
    r"""The derivative of the discrete solution, in reverse and in forward mode; the default of
    [`diffeqsolve`][].

    For the accepted steps $y_{i+1} = \Phi(t_i, t_{i+1}, y_i, \theta)$ and the gradient
    $\bar y_n$ with respect to the last state

    $$\bar y_i = (\partial\Phi/\partial y_i)^T \bar y_{i+1} + (\partial s_i/\partial y_i)^T \bar s_i, \qquad
      \bar\theta = \sum_i (\partial\Phi/\partial\theta)^T \bar y_{i+1} + \dots$$

    with $s_i$ the values saved in step $i$, events and the dense solution included. The solve
    records $(t_i, t_{i+1})$ and some $y_i$, and the reverse sweep computes each step again, with the
    recorded size. `diffrax.RecursiveCheckpointAdjoint` repeats parts of the solve with its
    controller instead: rounded differently, repeated steps get other sizes, and its gradient is
    that of another solution. At tight tolerances it is less accurate than the solve, and with
    additive methods (`KenCarp3` and a `MultiTerm`) it can be wrong.

    Forward mode differentiates the solve itself with the ends of its steps held fixed, so that both
    modes give the same numbers. (It still makes the record: where only forward mode is needed,
    `diffrax.ForwardMode()` takes less memory.)

    Derivatives are those with respect to `y0`, `args`, all that terms, constraints and `fn` hold or
    close over, `t0`, `t1`, `SaveAt(ts=...)` and the times that a controller prescribes (`jump_ts`, `step_ts`,
    `StepTo(ts=...)`). A field that jumps at a parameter needs that time in `jump_ts`: a step that ends at one of the
    others also evaluates the field there, behind the jump. Under `vmap` all trajectories share one counter.

    **Arguments:**

    - `checkpoints`: the largest number of states to record. By default those of the first 512 steps, or
        as many as fit into 1 MiB, and about `sqrt(max_steps)` of the others; the states between two of
        these are computed again, once, about `sqrt(max_steps)` at a time. `checkpoints=max_steps`
        records every state. Memory, besides these states: two numbers for each of `max_steps`.

    **Raises:**

    `ValueError` for an `UnsafeBrownianPath`. `RuntimeError` when differentiating with `max_steps=None`,
    as there is no room for the record, or with respect to `dt0`, on which a solution depends only by
    its error; and when a derivative of either mode is differentiated in reverse mode: in forward mode it can be
    (Hessian-vector products), otherwise use `diffrax.DirectAdjoint()`. Under `vmap` each trajectory sums up a
    gradient with respect to shared parameters, also if they are thousands (neural networks).

    Source: Griewank & Walther, Evaluating Derivatives (2008), ch. 12, without recursion.
    """

    checkpoints: int | None = None

    def __check_init__(self):
        if self.checkpoints is not None and self.checkpoints < 1:
            raise ValueError(
                f"`checkpoints` must be a positive integer, got {self.checkpoints!r}: the number of states to record."
            )

    def loop(self, *, event, **given: Any) -> Any:
        if event is not None and event.root_finder is not None:
            # The time of the event is found after the steps, which alone are made again.
            return LocatingAdjoint(self).loop(event=event, **given)
        return self._loop_over_steps(event=event, **given)

    def _loop_over_steps(
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
        passed_solver_state,
        progress_meter,
        **_: Any,
    ) -> Any:
        if is_unsafe_sde(terms):
            raise ValueError(
                "`adjoint=StepReplayAdjoint()` cannot repeat the steps of an `UnsafeBrownianPath`. Use a "
                "`VirtualBrownianTree`, or `adjoint=diffrax.ForwardMode()`."
            )
        prescribed = prescribed_times(stepsize_controller, Progress.of(init_state).tprev.dtype)
        times = t0, t1, [sub.ts for sub in subs_of(saveat)], prescribed
        dt0 = nondifferentiable(dt0, msg=_NO_STEP_SIZES)

        def run(outer_while_loop, made):
            controller = with_steps_held_fixed(stepsize_controller, made, t1)
            first = with_end_held_fixed(init_state, t1, made, prescribed)
            final_state, statistics = diffrax_loop(
                solver=_with_loops(solver, "lax"),
                stepsize_controller=controller,
                event=event_of_controller(event, stepsize_controller),
                saveat=saveat,
                t0=t0,
                t1=t1,
                dt0=dt0,
                max_steps=max_steps,
                terms=terms,
                args=args,
                init_state=numbered(controller, first),
                inner_while_loop=_while_loop,
                outer_while_loop=outer_while_loop,
                progress_meter=progress_meter,
            )
            return unnumbered(final_state), statistics

        twice = _with_loops(solver, "bounded")
        interpolates = saveat.dense or event is not None
        is_interpolated = interpolates or any(ts is not None for ts in times[2])
        memory_is_used = is_interpolated or saveat.solver_state or passed_solver_state
        solve = Solve.of(terms, twice, args, init_state, stepsize_controller, memory_is_used)
        start = solve.state(init_state)
        replay = Replay.build(solve, saveat, t0, start, interpolates)
        record = made = None
        if max_steps is not None:
            room = max(max_steps, 1), self.checkpoints
            kinds = solve.jumps, solve.resetting is not None, is_sde(terms)
            record = Record.empty(start, Progress.of(init_state).tprev.dtype, *room, *kinds)
            made = MadeSteps.none(record)

        def forward(record, made):
            if record is None:
                return run(_while_loop, None), None
            return recording(record, solve.state, lambda loop: run(loop, made))

        # Closed-over arrays of the functions become leaves, which have derivatives.
        forward = convert_closure(forward, record, made)
        differentiable = replay, start, times, forward
        (final_state, statistics), outputs, _ = _solve(
            differentiable, (record, made), solve.remembers
        )
        return with_outputs(final_state, outputs), statistics


_NO_STEP_SIZES = (
    "`dt0` has no derivative with `adjoint=StepReplayAdjoint()`, the default: what a solution depends on step sizes is "
    "its error. Pass `jax.lax.stop_gradient(dt0)`."
)
_FORWARDS_ALONE = (
    "A derivative with `adjoint=StepReplayAdjoint()`, the default, cannot be differentiated in reverse mode again. Write "
    "`jax.jacfwd(jax.grad(f))`, or pass `adjoint=diffrax.DirectAdjoint()`."
)
_UNBOUNDED = (
    "`max_steps` is None, but reverse mode needs room for the steps it records: pass a positive integer, or "
    "`adjoint=diffrax.ForwardMode()`."
)


def _while_loop(*args: Any, checkpoints: Any = None, **kwargs: Any) -> Any:
    return while_loop(*args, kind="lax", **kwargs)


@ForwardRule
def _solve(differentiable, empty, remembers):
    """Return the result of the loop; its differentiable part; the record and the final state."""
    *_, run = differentiable
    (state, statistics), record = run(*empty)
    return (state, statistics), outputs_of(state, remembers), (record, state)


@_solve.define_jvp
def _solve_jvp(values, primals, tangents):
    """In forward mode differentiate the loop itself, in reverse mode go through its record."""
    (differentiable, empty, remembers), (tangents_in, *_) = primals, tangents
    structure = jtu.tree_structure(differentiable)
    leaves_in = structure.flatten_up_to(tangents_in)  # None for leaves without a tangent
    is_perturbed = jtu.tree_unflatten(structure, [dx is not None for dx in leaves_in])
    arrays, static = eqx.partition((differentiable, empty, values), eqx.is_array)

    def forward(arrays, tangents):
        differentiable, (empty, made), values = eqx.combine(arrays, static)
        *_, (record, _) = values
        if record is not None:
            made = MadeSteps.of(record)
        each = iter(tangents)
        tangents = [None if dx is None else next(each) for dx in leaves_in]
        *_, run_tangent = jtu.tree_unflatten(structure, tangents)

        def final(run, made):
            (state, _), record = run(empty, made)
            values = outputs_of(state, remembers), (record, state)
            return eqx.filter(values, eqx.is_inexact_array)

        # That of the steps is not None, so that the rule with which they are made again is applied.
        primals = differentiable[-1], made
        along = run_tangent, jtu.tree_map(_zero_tangent, made)
        tangents_out = eqx.filter_jvp(final, primals, along)[1]
        return nondifferentiable_backward(tangents_out, msg=_FORWARDS_ALONE)

    def transpose(arrays, cotangents_out):
        differentiable, _, values = eqx.combine(arrays, static)
        gradient = structure.flatten_up_to(
            _gradient(differentiable, is_perturbed, values, cotangents_out)
        )
        wanted = [bar for bar, dx in zip(gradient, leaves_in, strict=True) if dx is not None]
        return nondifferentiable_backward(wanted, msg=_FORWARDS_ALONE)

    outputs_like = eqx.filter(values[1:], eqx.is_inexact_array)
    given = [dx for dx in leaves_in if dx is not None]
    tangents_out = apply_linear(forward, transpose, outputs_like, arrays, given)
    return jtu.tree_map(lambda _: None, values[0]), *tangents_out


def _zero_tangent(x: Any) -> Any:
    return jnp.zeros_like(x) if eqx.is_inexact_array(x) else None


def _gradient(differentiable, is_perturbed, values, cotangents_out):
    _, outputs, (record, final_state) = values
    # Nothing but this function reads the record and the final state.
    outputs_bar, _ = cotangents_out
    if record is None:
        raise RuntimeError(_UNBOUNDED)
    replay, start, (t0, t1, ts, prescribed), run = differentiable
    end = Progress.of(final_state)
    bar = with_zeros(eqx.filter(outputs, eqx.is_inexact_array), outputs_bar)
    if not is_perturbed[2][3]:
        prescribed = None
    ends = Ends(t0, t1, end.tprev, end.num_steps, end.num_accepted_steps, end.y, prescribed)
    functions = Functions(*eqx.partition(replay, is_perturbed[0]))
    dense = DenseBars(
        bar.dense_infos if jtu.tree_leaves(outputs_bar.dense_infos) else None,
        bar.event_dense_info if jtu.tree_leaves(outputs_bar.event_dense_info) else None,
    )
    saved = SavedValues(functions, ends, _rows(replay, save_states(final_state), bar, ends))
    resets = state_of_resets(end.controller_state)
    if resets is not None:
        resets = ResetBars(
            resets.record.number, bar.resets.rows, bar.dense_ts, bar.resets.last_start
        )
    back = ReverseSweep(functions, record, start, ends, saved, dense, resets)
    last_bar = State(bar.y, bar.solver_state)
    gradient = back.run(last_bar, timed=any(jtu.tree_leaves(is_perturbed[2])))
    times = gradient.times or TimesBar(None, None, [None] * len(ts), None)  # pyright: ignore[reportArgumentType]
    if gradient.times is not None and bar.dense_ts is not None:
        times = times.at_dense_times(ends, outputs.dense_ts, bar.dense_ts)
    return gradient.leaves, gradient.state, tuple(times), eqx.filter(run, lambda leaf: False)


def _rows(replay: Replay, saved: list[SaveState], bar: Differentiable, ends: Ends) -> list[Rows]:
    """Return the saved rows of each saving, with the cotangents of its values."""
    rows = []
    for saving, state, *bars in zip(replay.savings, saved, bar.ts, bar.ys, strict=True):
        count = jnp.asarray(saving.offset + state.saveat_ts_index)
        if saving.steps:
            count += ends.num_accepted // saving.steps
        rows.append(Rows(state.ts, count, *bars))
    return rows


def _with_loops(solver: Any, kind: str) -> Any:
    """Return the solver with the loop over its stages set, as the adjoints of Diffrax do: by default
    that loop supports neither forward mode nor forward over reverse mode."""
    if getattr(solver, "scan_kind", "none") is not None:
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
