"""Whether the linear systems of a step are solved with sparse matrices, and how."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._base.errors import listed
from .._base.klu import has_klu
from .._linalg.sparse import (
    Choice,
    dependence,
    program_of,
    SMALLEST,
    SMALLEST_KLU,
    Sparsity,
    SquarePattern,
)


# The largest number of colors as a part of the number of unknowns.
_MOST_COLORS = 1 / 3


def check_structure(structure: Any) -> None:
    if structure not in ("auto", "dense", "sparse"):
        raise ValueError(f"`structure` must be 'auto', 'dense' or 'sparse', got {structure!r}.")


def choose_sparsity(
    choice: Choice,
    function: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    x: Float[Array, " n"],
    mass: Float[Array, "..."] | None,
    massless: np.ndarray | None = None,
) -> Sparsity | None:
    """Return how systems with the matrix `M / gamma - h df/dx` are solved; `None` for dense matrices.
    `function` is `f` and whatever else the state has to do with in the equations. `massless` says of
    a diagonal which of its numbers are known to be zero.

    A multi-elimination does without exchanges of rows: right for small steps with a regular mass matrix.
    Algebraic equations may need exchanges, whatever their structure, and have KLU for them if it is installed.
    Each factorization is checked, see [`factorize_sparse`][].
    """
    n, is_matrix = x.size, mass is not None and mass.ndim == 2
    if choice == "dense" or (choice == "auto" and (n < SMALLEST or is_matrix)):
        return None
    pattern = _found(function, x, mass, massless)
    if pattern is None or (pattern.num_colors > _MOST_COLORS * n and n > SMALLEST):
        if choice == "sparse":
            raise ValueError(_NOT_SPARSE.format(n=n))
        return None
    if pattern.transversal is None:
        if choice == "sparse":
            raise ValueError(_singular(pattern))
        return None
    is_unknown = mass is not None and massless is None
    if choice == "auto" and is_unknown and not _has_diagonal(function, x):
        # Entries of the mass may be zero or not: exchanges of rows of dense matrices find out.
        return None
    with_klu = has_klu(x.dtype)
    is_regular = mass is None or (massless is not None and not massless.any())
    needs_no_exchanges = is_regular or len(pattern.on_diagonal) == n
    if pattern.block_order.width == 1:
        return Sparsity(pattern, "tridiagonal")
    has_plan = pattern.elimination_plan is not None
    may_use_klu = with_klu and (choice == "sparse" or n >= SMALLEST_KLU)
    if has_plan and may_use_klu and not is_regular:
        return Sparsity(pattern, "either")
    if has_plan and (needs_no_exchanges or choice == "sparse"):
        return Sparsity(pattern, "multi-elimination")
    if may_use_klu:
        return Sparsity(pattern, "klu")
    if choice == "sparse":
        raise ValueError(_NO_LIBRARY)
    return None


_NOT_SPARSE = (
    "`structure='sparse'`, but most of the {n} equations of `terms` depend on most numbers of `y`, as far as can be seen "
    "from the traced function. Write the indices and sparse matrices in them as NumPy arrays that the function closes "
    "over, not in `args`, or use `structure='dense'`."
)
_NO_LIBRARY = (
    "`structure='sparse'`, but eliminating the unknowns of `terms` one by one couples too many of the others to "
    "do without a library. Install klujax (`pip install klujax`, the extra `manifold_jax[sparse]`; for CPUs "
    "and 64-bit numbers), or use `structure='dense'`."
)


def _singular(pattern: SquarePattern) -> str:
    named = lambda numbers: listed([f"y[{i}]" for i in numbers], most=10) or "none"
    equations, unknowns = map(named, pattern.singular_parts.overdetermined)
    return (
        "`structure='sparse'`, but the equations of `terms` are structurally singular: however the unknowns are assigned to "
        "the equations, one of the equations is left without an unknown of its own. Those in the places of "
        f"{equations} are too many for the unknowns in them: {unknowns} (numbers of `y` as "
        "`jax.flatten_util.ravel_pytree` orders them). The index is above 1: reduce it, for example with `mj.reduce_dae`, "
        "or remove what is redundant."
    )


_FOUND: dict[Any, SquarePattern | None] = {}
_MOST_FOUND = 64


def _found(
    function: Callable,
    x: Float[Array, " n"],
    mass: Float[Array, "..."] | None,
    massless: np.ndarray | None,
) -> SquarePattern | None:
    """Return the pattern, which is cached for each traced program."""
    has_mass = np.ones(x.size, bool) if massless is None else ~massless
    functions = [function, lambda x: jnp.where(has_mass, x, 0)]
    if mass is not None and mass.ndim == 2:
        functions[1] = lambda x: mass @ x
    key = tuple(program_of(f, x) for f in functions)
    if key not in _FOUND:
        while len(_FOUND) >= _MOST_FOUND:
            _FOUND.pop(next(iter(_FOUND)))
        _FOUND[key] = _pattern(functions, x)
    return _FOUND[key]


def _has_diagonal(function: Callable, x: Float[Array, " n"]) -> bool:
    """Whether each equation depends on an unknown of its own, whatever the mass."""
    pattern = _found(function, x, None, np.ones(x.size, bool))
    return pattern is not None and len(pattern.on_diagonal) == x.size


def _pattern(functions: list[Callable], x: Float[Array, " n"]) -> SquarePattern | None:
    try:
        found = [dependence(function, x) for function in functions]
    except TypeError:  # `jax.custom_vjp`, which cannot be differentiated forwards
        return None
    if any(entries is None for entries in found):
        return None
    total: Any = sum(entries.astype(np.int64) for entries in found)  # pyright: ignore
    return SquarePattern(sp.csr_matrix(total))
