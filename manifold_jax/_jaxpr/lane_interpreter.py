"""The interpreter: evaluates a traced function with numbers instead of arrays."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from . import lane_structure as structure
from .lane_arithmetic import apply, ELEMENTWISE, elementwise
from .lane_arrays import Lanes, NotScalarError
from .lane_value import Columns, LaneValue, object_array, where
from .primitives import MOVES
from .trace import called, example, unrolled_scan, walk


# Arrays with more numbers than this stay whole.
_LARGEST_ARRAY = 1000
# Loops with at most this many iterations are written out.
_LONGEST_WRITTEN_OUT = 16


def call_in_lanes(lanes: Lanes, function: Callable, *args: Any) -> Any:
    """Return `function(*args)` in every lane. Leaves of `args` and of the result are [`LaneValue`][]s.
    Arrays that the function closes over are the same in every lane."""
    leaves, treedef = jtu.tree_flatten(args)
    examples = jtu.tree_unflatten(treedef, [example(v.shape, v.dtype) for v in leaves])
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*examples)
    out = evaluate(lanes, closed, leaves)
    return jtu.tree_unflatten(jtu.tree_structure(shape), out)


def evaluate(lanes: Lanes, function: Any, values: list[LaneValue]) -> list[LaneValue]:
    """Evaluate a jaxpr, with or without its constants."""
    return walk(function, values, LaneValue.of_constant, functools.partial(_evaluated, lanes))


def _evaluated(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    name = equation.primitive.name
    if any(jax.dtypes.issubdtype(v.aval.dtype, jax.dtypes.extended) for v in equation.outvars):  # pyright: ignore[reportPrivateImportUsage]
        raise NotScalarError(f"`{name}` makes random keys")
    if name in _CONTROL:
        out = _CONTROL[name](lanes, equation, values)
    elif (inner := called(equation)) is not None:
        return evaluate(lanes, inner, values)
    else:
        sizes = (v.aval.size for v in (*equation.outvars, *equation.invars))
        rule = _RULES.get(name) if max(sizes, default=0) <= _LARGEST_ARRAY else None
        out = None if rule is None else rule(lanes, equation, values)
    return _on_whole_arrays(lanes, equation, values) if out is None else out


def _on_whole_arrays(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    """Apply a primitive without a rule to whole arrays, mapped over the lanes."""
    lanes.whole.add(equation.primitive.name)
    lanes.count_operations(1)

    def bind(*operands: jax.Array) -> list[jax.Array]:
        out = equation.primitive.bind(*operands, **equation.params)
        return list(out) if equation.primitive.multiple_results else [out]

    if not values:
        return [LaneValue.of_constant(x) for x in bind()]
    out = jax.vmap(bind, in_axes=-1, out_axes=-1)(*(v.whole(lanes) for v in values))
    return [LaneValue.of_whole(x) for x in out]


def _linear_solve(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    before = lengths.matvec + lengths.vecmat
    constants = values[before : before + lengths.solve]
    return evaluate(lanes, jaxprs.solve, constants + values[sum(lengths) :])


def _cond(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    """Evaluate all branches, unless the index is known."""
    which, *operands = values
    branches = equation.params["branches"]
    if which.is_known:
        return evaluate(lanes, branches[int(which.known())], operands)
    number = which.numbers()[()]
    outs = [evaluate(lanes, branch, operands) for branch in branches]
    chosen = []
    for value, *cases in zip(*outs, strict=True):
        for k, case in enumerate(cases, 1):
            here = apply(lanes, lax.ge_p, {}, bool, [number, number.dtype.type(k)])
            value = _selected(lanes, here, case, value)
        chosen.append(value)
    return chosen


def _selected(lanes: Lanes, here: Any, a: LaneValue, b: LaneValue) -> LaneValue:
    pairs = zip(a.numbers().ravel(), b.numbers().ravel(), strict=True)
    out = [apply(lanes, lax.select_n_p, {}, a.dtype, [here, y, x]) for x, y in pairs]
    return LaneValue.of_numbers(object_array(out, a.shape), a.dtype)


def _scan(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue] | None:
    if equation.params["length"] > _LONGEST_WRITTEN_OUT:
        return None

    def item(x: LaneValue, i: int) -> LaneValue:
        return LaneValue.of_numbers(
            object_array(list(x.numbers()[i : i + 1].flat), x.shape[1:]), x.dtype
        )

    def stack(rows: list[LaneValue], aval: Any) -> LaneValue:
        numbers = [x for row in rows for x in row.numbers().flat]
        return LaneValue.of_numbers(object_array(numbers, aval.shape), aval.dtype)

    through = functools.partial(evaluate, lanes)
    return unrolled_scan(equation, values, through, item, stack)


def _while_loop(lanes: Lanes, equation: Any, values: list[LaneValue]) -> list[LaneValue]:
    """Evaluate a loop for as long as any lane goes on; the others keep their values."""
    params = equation.params
    m, n = params["cond_nconsts"], params["body_nconsts"]
    entering = lambda values: [value.entering(lanes) for value in values]
    cond_consts, body_consts = entering(values[:m]), entering(values[m : m + n])
    columns = Columns.of_values(values[m + n :], lanes)

    def goes_on(columns: Columns) -> jax.Array:
        values = [*entering(cond_consts), *columns.values()]
        return evaluate(lanes, params["cond_jaxpr"], values)[0].columns(lanes)[0]

    def body(carry: tuple[jax.Array, Columns]) -> tuple[jax.Array, Columns]:
        active, columns = carry
        with lanes.inside():
            values = [*entering(body_consts), *columns.values()]
            new = Columns.of_values(evaluate(lanes, params["body_jaxpr"], values), lanes)
            columns = where(active, new, columns)
            return active & goes_on(columns), columns

    start = goes_on(columns), columns
    return lax.while_loop(lambda carry: jnp.any(carry[0]), body, start)[1].values()


_RULES: dict[str, Callable] = {
    **dict.fromkeys(MOVES, structure.move),
    **dict.fromkeys(structure.REDUCTIONS, structure.reduce),
    **dict.fromkeys(ELEMENTWISE, elementwise),
    "dot_general": structure.dot_general,
    "iota": structure.iota,
    "platform_index": structure.platform,
}
_CONTROL = {
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "linear_solve": _linear_solve,
    "scan": _scan,
    "while": _while_loop,
}
