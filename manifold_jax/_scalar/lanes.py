"""What is known while a function is interpreted: how many lanes, what has been computed already."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .value import Number, spread


class NotScalarError(Exception):
    """The function cannot be treated, or would become too long."""


class Lanes:
    """`count` trajectories. `limit` is the largest number of operations; `whole` collects the names
    of operations that were done on whole arrays, as there is no rule for them."""

    def __init__(self, count: int, limit: int):
        self.count, self.limit = count, limit
        self.operations = 0
        self.whole: set[str] = set()
        self._known: list[dict[Any, tuple[Any, Number]]] = [{}]

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """The body of a loop: what is computed in it is not known outside."""
        self._known.append({})
        yield
        self._known.pop()

    def apply(self, primitive: Any, params: dict[str, Any], numbers: list[Number]) -> Number:
        """One operation on numbers, of which not all are constants; once, whoever asks for it."""
        key = self._key(primitive, params, numbers)
        for known in self._known:
            if key in known:
                return known[key][1]
        self.count_operations(1)
        out = primitive.bind(*self._alike(numbers), **params)
        if key is not None:
            # The operands are kept, so that no other object gets their identity.
            self._known[-1][key] = (numbers, out)
        return out

    def count_operations(self, count: int) -> None:
        self.operations += count
        if self.operations > self.limit:
            raise NotScalarError(f"more than {self.limit} operations")

    def _alike(self, numbers: list[Number]) -> list[jax.Array]:
        varying = any(not isinstance(x, np.generic) and jnp.ndim(x) == 1 for x in numbers)
        if varying:
            return [spread(x, self.count, x.dtype) for x in numbers]
        return [jnp.asarray(x) for x in numbers]

    def _key(self, primitive: Any, params: dict[str, Any], numbers: list[Number]) -> Any:
        same = [(x.dtype.str, x.tobytes()) if isinstance(x, np.generic) else id(x) for x in numbers]
        key = primitive.name, tuple(params.items()), tuple(same)
        try:
            hash(key)
        except TypeError:
            return None
        return key
