"""Functions with their own derivative rule, correct for derivatives of any order.

`jax.custom_jvp` loses its rule where JAX evaluates a loop partially, as reverse mode does with
`lax.scan`: the first derivative still follows the rule, but the second one differentiates the
function itself (seen with JAX 0.10.2 and 0.12.0: a root that is found under `stop_gradient` then
has none). A primitive keeps its rule through every transformation.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import jaxpr_as_fun, Primitive
from jax.interpreters import ad, batching, mlir


class ForwardRule:
    """A function of pytrees with a rule for its derivative in forward mode, written as

        @ForwardRule
        def function(*arguments): ...

        @function.define_jvp
        def rule(values, primals, tangents): ...

    `values` is what the function returns at `primals`; `rule` returns its tangents. Tangents are
    `None`, in both directions, for leaves that are not differentiated or are not real numbers.
    Reverse mode transposes the rule. All arrays must be in the arguments, none closed over.
    """

    def __init__(self, function: Callable):
        self._function = function
        self._rule: Callable | None = None
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__

    def define_jvp(self, rule: Callable) -> Callable:
        self._rule = rule
        return rule

    def __call__(self, *args: Any) -> Any:
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, inputs = jtu.tree_flatten(arrays)
        known: list[Any] = []

        def flat(*leaves: Any) -> list[Any]:
            out = self._function(*eqx.combine(jtu.tree_unflatten(inputs, leaves), static))
            out_arrays, out_static = eqx.partition(out, eqx.is_array)
            out_leaves, outputs = jtu.tree_flatten(out_arrays)
            known.append((outputs, out_static))
            return out_leaves

        closed = jax.make_jaxpr(flat)(*leaves)
        outputs, out_static = known[0]

        def flat_rule(values: list, primals: list, tangents: list) -> list:
            value = eqx.combine(jtu.tree_unflatten(outputs, values), out_static)
            primal = eqx.combine(jtu.tree_unflatten(inputs, primals), static)
            assert self._rule is not None
            along = self._rule(value, primal, jtu.tree_unflatten(inputs, tangents))
            return outputs.flatten_up_to(along)

        out = _ruled.bind(*leaves, call_jaxpr=closed, rule=flat_rule)
        return eqx.combine(jtu.tree_unflatten(outputs, out), out_static)


# The primitive: evaluates `call_jaxpr`; its derivative is `rule(values, primals, tangents)`.
_ruled = Primitive("call_with_derivative_rule")
_ruled.multiple_results = True


@_ruled.def_impl
def _evaluate(*primals: Any, call_jaxpr: Any, rule: Callable) -> list:
    del rule
    return jaxpr_as_fun(call_jaxpr)(*primals)


# From JAX 0.12 on: functions with operations that exist for tracing alone (`jnp.nonzero` has some) are
# evaluated again for the compiler, after all derivatives were taken.
_ruled.to_lojax = _evaluate


@_ruled.def_effectful_abstract_eval
def _shapes(*primals: Any, call_jaxpr: Any, rule: Callable) -> tuple[list, Any]:
    del primals, rule
    return call_jaxpr.out_avals, call_jaxpr.effects


def _differentiate(primals: Any, tangents: Any, *, call_jaxpr: Any, rule: Callable) -> tuple:
    primals = [_as_array(x) for x in primals]
    values = _ruled.bind(*primals, call_jaxpr=call_jaxpr, rule=rule)
    given = [_none_if_zero(x, dx) for x, dx in zip(primals, tangents, strict=True)]
    found = rule(values, primals, given)
    zero = lambda x: ad.Zero(jax.typeof(x).to_tangent_aval())
    along = [zero(x) if dx is None else dx for x, dx in zip(values, found, strict=True)]
    return values, along


def _as_array(x: Any) -> Any:
    """Convert also the literals of a traced function, which may be Python's numbers."""
    return jnp.asarray(x, getattr(x, "dtype", None))


def _none_if_zero(x: Any, dx: Any) -> Any:
    undifferentiated = type(dx) is ad.Zero or not jnp.issubdtype(x.dtype, jnp.inexact)
    return None if undifferentiated else dx


def _batch(primals: Any, axes: Any, *, call_jaxpr: Any, rule: Callable) -> tuple:
    axes = [axis if isinstance(axis, int) else None for axis in axes]

    def mapped_rule(values: list, primals: list, tangents: list) -> list:
        given = [None if dx is None else axis for dx, axis in zip(tangents, axes, strict=True)]
        return jax.vmap(rule, ([0] * len(values), axes, given))(values, primals, tangents)

    closed = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(call_jaxpr), axes))(*primals)
    out = _ruled.bind(*primals, call_jaxpr=closed, rule=mapped_rule)
    return out, [0] * len(out)


def apply_linear(
    forward: Callable, transpose: Callable, like: Any, primals: Any, tangents: Any
) -> Any:
    """Return `forward(primals, tangents)`, which is linear in the tangents; reverse mode calls
    `transpose(primals, cotangents)` instead of transposing it operation by operation.

    Tangents and cotangents are `None` where there are none. The result has the structure and shapes
    of `like`; neither function is traced before it is needed.
    """
    (primal_leaves, in_tree), (tangent_leaves, along) = map(jtu.tree_flatten, (primals, tangents))
    like_leaves, out_tree = jtu.tree_flatten(like)

    def flat_forward(primals: list, tangents: list) -> list:
        out = forward(jtu.tree_unflatten(in_tree, primals), jtu.tree_unflatten(along, tangents))
        found = zip(like_leaves, out_tree.flatten_up_to(out), strict=True)
        return [jnp.zeros_like(x) if dx is None else dx for x, dx in found]

    def flat_transpose(primals: list, cotangents: list) -> list:
        bar = jtu.tree_unflatten(out_tree, cotangents)
        return along.flatten_up_to(transpose(jtu.tree_unflatten(in_tree, primals), bar))

    out = _linear.bind(
        *primal_leaves,
        *tangent_leaves,
        forward=flat_forward,
        transpose=flat_transpose,
        num_primals=len(primal_leaves),
        avals=tuple(jax.typeof(x).to_tangent_aval() for x in like_leaves),
    )
    return jtu.tree_unflatten(out_tree, out)


# The primitive: `forward(primals, tangents)`.
_linear = Primitive("linear_with_transpose_rule")
_linear.multiple_results = True


@_linear.def_impl
def _evaluate_linear(*operands: Any, forward: Callable, num_primals: int, **_: Any) -> list:
    return forward(list(operands[:num_primals]), list(operands[num_primals:]))


@_linear.def_abstract_eval
def _shapes_of_linear(*operands: Any, avals: tuple, **_: Any) -> tuple:
    del operands
    return avals


def _differentiate_linear(operands: Any, along: Any, **params: Any) -> tuple:
    k, forward = params["num_primals"], params["forward"]
    operands = [_as_array(x) for x in operands]
    primals, tangents = operands[:k], operands[k:]
    out = _linear.bind(*operands, **params)
    given = [ad.instantiate_zeros(dx) for dx in along]
    total = _linear.bind(*primals, *given[k:], **params)
    if any(_none_if_zero(x, dx) is not None for x, dx in zip(primals, along, strict=False)):
        _, more = jax.jvp(lambda primals: forward(primals, tangents), (primals,), (given[:k],))
        total = [a + b for a, b in zip(total, more, strict=True)]
    return out, total


def _transpose_linear(cotangents: Any, *operands: Any, **params: Any) -> list:
    k = params["num_primals"]
    given = [None if type(bar) is ad.Zero else bar for bar in cotangents]
    if all(bar is None for bar in given):
        return [None] * len(operands)
    return [None] * k + params["transpose"](list(operands[:k]), given)


def _batch_linear(operands: Any, axes: Any, **params: Any) -> tuple:
    k, forward, transpose = params["num_primals"], params["forward"], params["transpose"]
    (size,) = {x.shape[a] for x, a in zip(operands, axes, strict=True) if isinstance(a, int)}
    primal_axes = [a if isinstance(a, int) else None for a in axes[:k]]
    tangents = [
        jnp.moveaxis(x, a, 0) if isinstance(a, int) else jnp.broadcast_to(x, (size, *x.shape))
        for x, a in zip(operands[k:], axes[k:], strict=True)
    ]

    def mapped_transpose(primals: list, cotangents: list) -> list:
        given = [None if bar is None else 0 for bar in cotangents]
        return jax.vmap(transpose, (primal_axes, given), axis_size=size)(primals, cotangents)

    params |= dict(
        forward=jax.vmap(forward, (primal_axes, 0), axis_size=size),
        transpose=mapped_transpose,
        avals=tuple(aval.update(shape=(size, *aval.shape)) for aval in params["avals"]),
    )
    out = _linear.bind(*operands[:k], *tangents, **params)
    return out, [0] * len(out)


ad.primitive_jvps[_linear] = _differentiate_linear
ad.primitive_transposes[_linear] = _transpose_linear
batching.primitive_batchers[_linear] = _batch_linear
mlir.register_lowering(_linear, mlir.lower_fun(_evaluate_linear, multiple_results=True))
ad.primitive_jvps[_ruled] = _differentiate
batching.primitive_batchers[_ruled] = _batch
mlir.register_lowering(_ruled, mlir.lower_fun(_evaluate, multiple_results=True))
