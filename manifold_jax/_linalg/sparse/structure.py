"""The structure of `C M^-1 C^T` for a sparse `C`, found while tracing."""

import functools
from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import jax
import jax.core
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from ..coloring import greedy_colors
from .block_order import BlockOrder
from .pattern import dependence


Choice: TypeAlias = Literal["auto", "dense", "sparse"]

# Number of equations from which on the sparse form is faster, and the largest width of blocks as a part
# of that number for which it is: `python -m benchmarks.speed.bandwidths`.
_SMALLEST = 32
_WIDEST = 1 / 6


class Structure:
    """The sparsity structure of `m` equations in `n` unknowns, of which `per_block` neighbours have
    masses that are coupled.

    - `block_order`: the order of the equations in which `C M^-1 C^T` is block tridiagonal.
    - `color`: of each unknown; no equation depends on two of the same color.
    - `local`: the equations that depend on unknowns of one block of masses only.
    """

    def __init__(self, depends: sp.csr_matrix, per_block: int):
        self.num_equations: int = depends.shape[0]  # pyright: ignore[reportOptionalSubscript]
        self._depends, self._per_block = depends, per_block
        blocks = _merged(depends, per_block)
        coupled = (blocks @ blocks.T).tocoo()
        self.block_order = BlockOrder.best(coupled)
        self.local = np.diff(blocks.indptr) == 1

    @functools.cached_property
    def _contents(self) -> tuple:
        depends = self._depends
        per_block, shape = self._per_block, depends.shape
        return per_block, shape, depends.indptr.tobytes(), depends.indices.tobytes()

    def __eq__(self, other: object) -> bool:
        """Compare by contents: a structure that is found again is the same static field."""
        return isinstance(other, Structure) and self._contents == other._contents

    def __hash__(self) -> int:
        return hash(self._contents)

    @functools.cached_property
    def color(self) -> np.ndarray:
        return greedy_colors(self._depends.T @ self._depends)

    @property
    def num_colors(self) -> int:
        return int(self.color.max(initial=0)) + 1


def check_choice(structure: Any, redundant: bool) -> None:
    if structure not in ("auto", "dense", "sparse"):
        raise ValueError(f"`structure` must be 'auto', 'dense' or 'sparse', got {structure!r}.")
    if structure == "sparse" and redundant:
        raise ValueError(
            "`structure='sparse'` needs independent constraints, as its elimination cannot tell which depend on others. "
            "Remove the dependent ones, or use `structure='dense'` with `redundant=True`."
        )


def choose_structure(
    choice: Choice,
    equations: tuple[tuple[Callable, Float[Array, " n"]], ...],
    mass_shape: tuple[int, ...] = (),
) -> Structure | None:
    """Return the structure, or `None` for dense matrices. `equations` are functions of one vector each,
    all of the same length, whose numbers have the masses."""
    if choice == "dense":
        return None
    if len(mass_shape) == 2:
        if choice == "sparse":
            raise ValueError(_FULL_MASS.format(shape=mass_shape))
        return None
    per_block = mass_shape[-1] if len(mass_shape) == 3 else 1
    m = sum(jax.eval_shape(function, x).size for function, x in equations)
    if choice == "auto" and m < _SMALLEST:
        return None
    structure = structure_of(equations, per_block)
    if choice == "auto":
        return None if structure is None or structure.block_order.width > m * _WIDEST else structure
    if structure is None or (m > _SMALLEST and 3 * structure.block_order.width > m):
        found = "most of them depend on most coordinates"
        if structure is not None:
            found = f"reordered, they are coupled in blocks of {structure.block_order.width}"
        raise ValueError(_NOT_SPARSE.format(m=m, found=found))
    return structure


_FULL_MASS = (
    "`structure='sparse'`, but `mass_matrix` is a full matrix of shape {shape}. Return a diagonal, or the blocks on the "
    "diagonal, one per body, as an array of shape (bodies, d, d); or use `structure='dense'`."
)
_NOT_SPARSE = (
    "`structure='sparse'`, but the {m} constraints are not: {found}. Use `structure='dense'`, or write equations of few "
    "neighbours each: no cumulative sums, and indices as NumPy arrays that the function closes over, not in `args`."
)


_FOUND: dict[Any, Structure | None] = {}
_MOST_FOUND = 64


def structure_of(equations: Any, per_block: int = 1) -> Structure | None:
    """Return the structure as for `choose_structure`, if there is any. It is cached for each traced
    program, which is evaluated in many places."""
    key = per_block, *(program_of(function, x) for function, x in equations)
    if key not in _FOUND:
        patterns = [dependence(function, x) for function, x in equations]
        structure = None
        if all(pattern is not None for pattern in patterns):
            structure = Structure(sp.csr_matrix(sp.vstack(patterns)), per_block)
        while len(_FOUND) >= _MOST_FOUND:
            _FOUND.pop(next(iter(_FOUND)))
        _FOUND[key] = structure
    return _FOUND[key]


def program_of(function: Callable, x: Float[Array, " n"]) -> tuple:
    """Return the traced function as text, and the constants in it."""
    closed = jax.make_jaxpr(function)(x)
    return str(closed.jaxpr), *(_constant(value) for value in closed.consts)


def _constant(value: Any) -> Any:
    if isinstance(value, jax.core.Tracer):
        return None
    value = np.asarray(value)
    return str(value.dtype), value.shape, value.tobytes()


def _merged(depends: sp.csr_matrix, per_block: int) -> sp.csr_matrix:
    """Join the columns that belong to the same block of masses."""
    if per_block == 1:
        return depends.astype(np.int64)  # pyright: ignore[reportReturnType]
    entries = depends.tocoo()
    shape = entries.shape[0], -(-entries.shape[1] // per_block)  # pyright: ignore[reportOptionalSubscript]
    joined = sp.csr_matrix((entries.data, (entries.row, entries.col // per_block)), shape)
    joined.sum_duplicates()
    return joined.astype(np.int64)  # pyright: ignore[reportReturnType]
