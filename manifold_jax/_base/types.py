"""Types shared by every module, and the shape letters used in annotations.

Letters: `n` state components, `m` constraints, `d = n - m` the dimension of the manifold. `Y` is any
pytree of real floating-point arrays; internally a state is ravelled once into a vector of shape `(n,)`.
"""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING, TypeAlias

import diffrax as dfx
from jaxtyping import Array, Bool, Float, Int, PyTree


Y: TypeAlias = PyTree[Any]
Args: TypeAlias = PyTree[Any]
Residual: TypeAlias = PyTree[Any]
ResidualFunction: TypeAlias = Callable[[Any, Y, Args], Residual]

# Type checkers refuse a bare function; when it runs, a message says what to write.
if TYPE_CHECKING:
    Terms: TypeAlias = dfx.AbstractTerm | tuple[Any, ...]
else:
    Terms = Any

RealScalarLike: TypeAlias = float | int | Float[Any, ""] | Int[Any, ""]
BoolScalar: TypeAlias = Bool[Array, ""]
IntScalar: TypeAlias = Int[Array, ""]
FloatScalar: TypeAlias = Float[Array, ""]
