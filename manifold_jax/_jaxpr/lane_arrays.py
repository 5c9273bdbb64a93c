"""The state of the interpreter: the number of lanes, and the operations computed so far."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .lane_value import Node, Number


class NotScalarError(Exception):
    """Raised for a function without a rule, or with too many operations."""


# XLA for CPUs copies a result, with all that leads to it, into every kernel that needs it, except
# for results of these operations.
_COMPUTED_ONCE = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cosh div erf exp exp2 expm1 log log1p logistic pow rem "
    "rsqrt sinh sqrt tan tanh".split()
)
# Not among them, but as expensive as this many other operations.
_LONG = {"sin": 50, "cos": 50}
# Largest number of operations that may be copied. A division, the cost of having a result computed
# once, takes as long. (Measured: 16 is 5 % faster than 8, and compiles in 0.9 of the time.)
_DIVISION = 16


class Lanes:
    """`count` trajectories, one in each lane. `limit` is the largest number of operations; `whole`
    collects the names of primitives without a rule, which are applied to whole arrays."""

    def __init__(self, count: int, limit: int):
        self.count, self.limit = count, limit
        self.operations = 0
        self.whole: set[str] = set()
        self._known: list[dict[Any, Node]] = [{}]
        self._one: jax.Array | None = None

    @contextlib.contextmanager
    def inside(self, finite: jax.Array | None = None) -> Iterator[None]:
        """Enter the body of a loop: results computed in it are not known outside. `finite` is a
        column of numbers that are never infinite."""
        before = self._one
        if finite is not None:
            # A one that XLA does not recognize as a constant.
            self._one = jnp.where(finite == finite, jnp.ones_like(finite), finite)
        self._known.append({})
        yield
        self._known.pop()
        self._one = before

    def apply(self, primitive: Any, params: dict[str, Any], dtype: Any, *numbers: Number) -> Node:
        """Return the node of an operation on numbers that are not all constants; equal ones share it."""
        key = self._key(primitive, params, numbers)
        if key is not None and key in self._known[-1]:
            return self._known[-1][key]
        self.count_operations(1)
        node = Node(primitive, params, dtype, numbers)
        if key is not None:
            self._known[-1][key] = node  # keeps its operands alive, and so their ids
        return node

    def count_operations(self, count: int) -> None:
        self.operations += count
        if self.operations > self.limit:
            raise NotScalarError(f"more than {self.limit} operations")

    def array(self, x: Number, dtype: Any) -> jax.Array:
        """Return one number for each lane, shape `(count,)`."""
        x = self.emitted(x)
        if isinstance(x, np.generic):
            return lax.full((self.count,), x, dtype)  # pyright: ignore[reportArgumentType]
        return x if x.ndim == 1 else lax.broadcast(x, (self.count,))

    def emitted(self, x: Number) -> Any:
        """Return a number once its operation has been given to XLA; constants stay as they are."""
        if not isinstance(x, Node):
            return x
        pending = [x]
        while pending:
            node = pending[-1]
            if node.array is not None:
                pending.pop()
                continue
            missing = [y for y in node.operands if isinstance(y, Node) and y.array is None]
            if missing:
                pending.extend(missing)
            else:
                self._emit(node)
                pending.pop()
        return x.array

    def _emit(self, node: Node) -> None:
        operands = [y.array if isinstance(y, Node) else y for y in node.operands]
        if any(not isinstance(y, np.generic) and y.ndim == 1 for y in operands):  # pyright: ignore[reportOptionalMemberAccess]
            arrays = [self.array(y, y.dtype) for y in operands]  # pyright: ignore[reportOptionalMemberAccess]
        else:
            arrays = [jnp.asarray(y) for y in operands]
        array = node.primitive.bind(*arrays, **node.params)
        operands = sum(y.copied for y in node.operands if isinstance(y, Node))
        node.copied = _LONG.get(node.primitive.name, 1) + operands
        one = self._one
        settles = one is not None and array.ndim == 1 and array.dtype == one.dtype
        if node.primitive.name in _COMPUTED_ONCE:
            node.copied = 0
        elif settles and node.copied * (node.uses - 1) > _DIVISION:
            array, node.copied = array / one, 0
        node.array = array

    def _key(self, primitive: Any, params: dict[str, Any], numbers: tuple[Number, ...]) -> Any:
        same = [(x.dtype.str, x.tobytes()) if isinstance(x, np.generic) else id(x) for x in numbers]
        key = primitive.name, tuple(params.items()), tuple(same)
        try:
            hash(key)
        except TypeError:
            return None
        return key
