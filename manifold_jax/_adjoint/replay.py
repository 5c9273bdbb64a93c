"""The way back: the recorded steps in reverse order, each computed and transposed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float, Int

from .._compat import unvmap_max
from .._custom_types import Args, IntScalar, RealScalarLike, Y
from .._projection import ProjectionInfo
from .._solver.explicit import explicit_step, is_unrollable
from .record import Record


# Interpolated values whose steps are transposed side by side.
_CHUNK = 32


class Saving(eqx.Module):
    """One `SubSaveAt`: which rows it has, and the functions that make them."""

    offset: int = eqx.field(static=True)  # 1 if the first row is that of `t0`, else 0
    num_times: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    end: bool = eqx.field(static=True)
    at_state: Callable  # (t, y)
    in_step: Callable | None  # (t, start, end, y)


class Replay(eqx.Module):
    """A solve as functions of single steps. What they close over are their leaves."""

    # (start, end, y, times) -> next state, what each of the savings keeps of it, at its time
    step: Callable
    savings: list[Saving]

    @staticmethod
    def build(terms: Any, solver: Any, args: Args, saveat: dfx.SaveAt, t: Array, y: Y) -> "Replay":
        subs = jtu.tree_leaves(saveat.subs, is_leaf=lambda x: isinstance(x, dfx.SubSaveAt))

        def attempt(start, end, y):
            if is_unrollable(solver, terms, start, end, y, args):  # a solver of Diffrax itself
                unchanged = lambda y: (y, ProjectionInfo.of_nothing(y, jnp.asarray(True)))
                f0 = terms.vf(start, y, args)
                y1, _, _, dense_info, _, _ = explicit_step(
                    solver.tableau, terms, terms, start, end, y, args, f0, unchanged
                )
                return y1, dense_info
            state = solver.init(terms, start, end, y, args)
            y1, _, dense_info, _, _ = solver.step(terms, start, end, y, args, state, False)
            return y1, dense_info

        def step(start, end, y, times):
            y1, _ = attempt(start, end, y)
            saved = zip(subs, times, strict=True)
            return y1, [sub.fn(t, y1, args) if sub.steps else None for sub, t in saved]

        def saving(sub: dfx.SubSaveAt) -> Saving:
            def in_step(t, start, end, y):
                _, dense_info = attempt(start, end, y)
                interpolation = solver.interpolation_cls(t0=start, t1=end, **dense_info)
                return sub.fn(t, interpolation.evaluate(t), args)

            convert = eqx.filter_closure_convert
            at_state = convert(lambda t, y: sub.fn(t, y, args), t, y)
            between = None if sub.ts is None else convert(in_step, t, t, t, y)
            num_times = 0 if sub.ts is None else len(sub.ts)
            at_end = sub.t1 and sub.steps != 1  # with every step the last row is one of those
            return Saving(int(sub.t0), num_times, sub.steps, at_end, at_state, between)

        step = eqx.filter_closure_convert(step, t, t, y, [t] * len(subs))
        return Replay(step, [saving(sub) for sub in subs])


class Rows(NamedTuple):
    """What one of the savings has saved: times, the steps in which they lie, how many rows are
    used, their cotangents."""

    times: Float[Array, " rows"]
    steps: Int[Array, " rows"]
    count: IntScalar
    cotangents: Any  # leading axis: rows


class _Steps(NamedTuple):
    """One step, or with a leading axis several."""

    starts: Float[Array, "*steps"]
    ends: Float[Array, "*steps"]
    accepted: Bool[Array, "*steps"]
    states: Y  # from which they were made


class _Gradient(NamedTuple):
    """With respect to the state behind accepted step `number`, and to the leaves of the functions
    so far."""

    number: IntScalar
    y: Y
    leaves: Any


def replay_backwards(
    replay: Replay,
    perturbed: Any,
    record: Record,
    counts: tuple[IntScalar, IntScalar],
    rows: list[Rows],
    y0: Y,
    last: tuple[RealScalarLike, Y],
) -> tuple[Any, Y]:
    """Gradients with respect to the leaves of `replay` and to `y0`. `counts` are the numbers of
    all steps and of the accepted ones."""
    leaves, rest = eqx.partition(replay, perturbed)
    _, unravel = jfu.ravel_pytree(y0)
    back = _Backwards(leaves, rest, record, unravel, *counts, rows)
    gradient = _Gradient(counts[1], *jtu.tree_map(jnp.zeros_like, (y0, leaves)))
    gradient = back.through_end(gradient, *last)
    total = unvmap_max(counts[0])
    num_blocks = -(-total // record.block)

    def through_block(carry):
        i, gradient = carry
        return i - 1, back.through_block(gradient, i - 1, total)

    _, gradient = lax.while_loop(lambda carry: carry[0] > 0, through_block, (num_blocks, gradient))
    t0 = jnp.where(counts[0] > 0, record.steps[0, 0, 0], last[0])  # without a step the same
    gradient = back.through_start(gradient, t0, y0)
    return gradient.leaves, gradient.y


class _Backwards(eqx.Module):
    leaves: Any
    rest: Any
    record: Record
    unravel: Callable
    num_steps: IntScalar
    num_accepted: IntScalar
    rows: list[Rows]

    def through_end(self, gradient: _Gradient, t: RealScalarLike, y: Y) -> _Gradient:
        for k, saving in enumerate(self.rest.savings):
            if saving.end:
                unsaved = saving.steps == 0 or self.num_accepted % saving.steps != 0
                last = jnp.arange(len(self.rows[k].times)) == self.rows[k].count - 1
                gradient = self._add_rows(gradient, k, last & unsaved, t, y)
        return gradient

    def through_start(self, gradient: _Gradient, t: RealScalarLike, y0: Y) -> _Gradient:
        """The row of `t0`; without any step (`t0 == t1`) those of `ts` are copies of it."""
        for k, saving in enumerate(self.rest.savings):
            row = jnp.arange(len(self.rows[k].times))
            copies = jnp.where(self.num_steps == 0, saving.num_times, 0)
            gradient = self._add_rows(gradient, k, row < saving.offset + copies, t, y0)
        return gradient

    def _add_rows(
        self, gradient: _Gradient, k: int, used: Bool[Array, " rows"], t: RealScalarLike, y: Y
    ) -> _Gradient:
        """The rows of saving `k` that are the same function of one state."""

        def value(leaves: Any, y: Y) -> Any:
            return self._replay(leaves).savings[k].at_state(t, y)

        bar = jtu.tree_map(lambda b: jnp.sum(_only(used, b), axis=0), self.rows[k].cotangents)
        _, pullback = jax.vjp(value, self.leaves, y)
        leaves_bar, y_bar = pullback(bar)
        add = lambda a, b: jtu.tree_map(jnp.add, a, b)
        return gradient._replace(y=add(gradient.y, y_bar), leaves=add(gradient.leaves, leaves_bar))

    def _replay(self, leaves: Any) -> Replay:
        return eqx.combine(leaves, self.rest)

    def _steps_of_block(self, i: IntScalar) -> _Steps:
        record = self.record
        accepted = record.steps[i, :, 2] > 0
        # Rows of no accepted step hold the first one: functions may refuse what is not a state
        # or time.
        used = lambda x: jnp.where(accepted[:, None], x[i], x[0, 0])
        starts, ends, _ = jnp.moveaxis(used(record.steps), 1, 0)
        if record.every_state:
            return _Steps(starts, ends, accepted, jax.vmap(self.unravel)(used(record.states)))

        def advance(y, xs):
            start, end, accepted = xs
            y1, _ = self._replay(self.leaves).step(start, end, y, [end] * len(self.rows))
            keep = lambda a, b: jnp.where(accepted, a, b)
            return jtu.tree_map(keep, y1, y), y

        unfinished = i * record.block < self.num_steps
        start = jnp.where(unfinished, record.states[i], record.states[0])
        _, states = lax.scan(advance, self.unravel(start), (starts, ends, accepted))
        return _Steps(starts, ends, accepted, states)

    def through_block(self, gradient: _Gradient, i: IntScalar, total: IntScalar) -> _Gradient:
        first, steps = i * self.record.block, self._steps_of_block(i)
        bars, leaves = jtu.tree_map(jnp.zeros_like, steps.states), gradient.leaves
        for k, saving in enumerate(self.rest.savings):
            if saving.num_times:
                bars, leaves = self._interpolated(k, first, steps, bars, leaves)

        # Fetched one step ahead: XLA would copy the slices into every kernel that needs them.
        fetched = lambda i: jtu.tree_map(lambda x: x[jnp.maximum(i, 0)], (steps, bars))

        def through_step(carry):
            i, gradient, current = carry
            return i - 1, self._through_step(gradient, *current), fetched(i - 1)

        last = jnp.minimum(total - first, self.record.block) - 1
        start = last, gradient._replace(leaves=leaves), fetched(last)
        return lax.while_loop(lambda carry: carry[0] >= 0, through_step, start)[1]

    def _through_step(self, gradient: _Gradient, step: _Steps, bar: Y) -> _Gradient:
        """`bar`: cotangent of the state before the step, of what was interpolated in it."""
        live, number = step.accepted, gradient.number

        def saved_bar(saving: Saving, rows: Rows) -> tuple[Any, RealScalarLike]:
            if not saving.steps:
                return None, step.ends
            row = saving.offset + number // saving.steps - 1
            saved = live & (number % saving.steps == 0)
            # The time that was saved is that behind a jump at which the step ended.
            time = jnp.where(saved, rows.times[row], step.ends)
            return jtu.tree_map(lambda b: jnp.where(saved, b[row], 0), rows.cotangents), time

        savings = zip(self.rest.savings, self.rows, strict=True)
        saved, times = zip(*(saved_bar(saving, rows) for saving, rows in savings), strict=True)

        def values(leaves: Any, y: Y) -> tuple[Y, list[Any]]:
            return self._replay(leaves).step(step.starts, step.ends, y, list(times))

        _, pullback = jax.vjp(values, self.leaves, step.states)
        leaves_bar, y_bar = pullback((gradient.y, list(saved)))
        return _Gradient(
            jnp.where(live, number - 1, number),
            jtu.tree_map(lambda new, old, b: jnp.where(live, new, old) + b, y_bar, gradient.y, bar),
            jtu.tree_map(lambda a, b: a + jnp.where(live, b, 0), gradient.leaves, leaves_bar),
        )

    def _interpolated(
        self, k: int, start: IntScalar, steps: _Steps, bars: Y, leaves: Any
    ) -> tuple[Y, Any]:
        """Cotangents of the rows interpolated in these steps, the first of which is number
        `start`, with respect to the states from which they were made, and to the leaves."""
        saving, rows = self.rest.savings[k], self.rows[k]
        stop = start + steps.starts.shape[0]
        row, step = jnp.arange(len(rows.times)), rows.steps
        valid = (row >= saving.offset) & (row < saving.offset + saving.num_times)
        # A solve that ended early saved fewer: the row of its end follows on those.
        valid &= (row < rows.count - int(saving.end)) & (step < self.num_steps)
        first = saving.offset + jnp.sum(valid & (step < start))
        count = jnp.sum(valid & (step >= start) & (step < stop))

        def chunk(carry):
            c, bars, leaves = carry
            index = c * _CHUNK + jnp.arange(min(_CHUNK, len(rows.times)))
            used = index < count
            index = jnp.where(used, first + index, first)
            bars, leaves_bar = self._chunk(k, steps, bars, index, step[index] - start, used)
            leaves = jtu.tree_map(lambda a, b: a + jnp.where(count > 0, b, 0), leaves, leaves_bar)
            return c + 1, bars, leaves

        num_chunks = unvmap_max(-(-count // _CHUNK))
        empty = jnp.zeros_like(num_chunks), bars, leaves
        return lax.while_loop(lambda carry: carry[0] < num_chunks, chunk, empty)[1:]

    def _chunk(
        self,
        k: int,
        steps: _Steps,
        bars: Y,
        index: Int[Array, " chunk"],
        step: Int[Array, " chunk"],
        used: Bool[Array, " chunk"],
    ) -> tuple[Y, Any]:
        bar = jtu.tree_map(lambda b: _only(used, b[index]), self.rows[k].cotangents)
        t, start, end = self.rows[k].times[index], steps.starts[step], steps.ends[step]

        def values(leaves, states):
            f = self._replay(leaves).savings[k].in_step
            return jax.vmap(f)(t, start, end, states)

        _, pullback = jax.vjp(values, self.leaves, jtu.tree_map(lambda y: y[step], steps.states))
        leaves_bar, states_bar = pullback(bar)
        add = lambda b, s: b.at[step].add(_only(used, s))
        return jtu.tree_map(add, bars, states_bar), leaves_bar


def _only(used: Bool[Array, " rows"], x: Float[Array, "rows ..."]) -> Float[Array, "rows ..."]:
    """The rows that are used, zeros for the others, whatever they hold."""
    return jnp.where(used.reshape(used.shape + (1,) * (x.ndim - 1)), x, 0)
