"""The term `M y' = f`, and the forms in which users give its mass matrix."""

from collections.abc import Callable
from typing import Any, NoReturn

import diffrax as dfx
import equinox as eqx
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.errors import clear_errors
from .._base.numbers import numbers_as_arrays
from .._base.shapes import are_alike, shapes
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.checks import check_field_is_real, check_state
from .._constraint.diagnosis import Diagnosis
from .._constraint.projection_info import ProjectionInfo
from .algebraic import consistent, faults_of_start, MassMatrixEquations
from .packed import packed, unpacked


class MassMatrixTerm(dfx.AbstractTerm):
    r"""`M(t, y, args) y' = f(t, y, args)`: an implicit ODE, or where `M` is singular a
    differential-algebraic equation (DAE) of index 1.

    For [`Rodas5P`][], [`Rodas3P`][] and [`RadauIIA5`][], alone or in [`Projected`][]. All other
    solvers would ignore the mass matrix, and raise.

    The left null space of `M` says which equations are algebraic: $u^T M = 0$ leaves
    $0 = u^T f(t, y)$. The index is 1 where these equations determine the part of `y` that `M` does
    not see: where $M + P\, \partial f/\partial y$ is nonsingular, with `P` the projector onto that null
    space. With a higher index (mechanics with constraints on positions, constraints of optimal
    control) reduce it first, for example with `mj.reduce_dae`.

    **Arguments:**

    - `vector_field`: `f(t, y, args)`, of the structure of `y`. In an algebraic equation it is what
        has to be zero.
    - `mass`: the matrix, or a callable `M(t, y, args)` that returns it: a scalar, the diagonal (shape
        `(n,)`, or a pytree with the structure and shapes of `y`), or a matrix of shape `(n, n)`, for
        the `n` numbers of `y` in the order of `jax.flatten_util.ravel_pytree`. Of constant rank, or of one that
        changes at times which the controller knows (`jump_ts` of `diffrax.ClipStepSizeController`). Where
        a mass passes through zero solutions are in general not unique beyond, and nothing says so.
    - `controlled`: which of the `n` numbers of `y` count in the error of a step, booleans of shape `(n,)`;
        all by default. Leave out auxiliary unknowns in which the equations are linear, such as derivatives
        of others: these may be large between zeros at which no relative tolerance can be met.

    The initial value has to satisfy the algebraic equations. [`mj.diffeqsolve`][] sees to that
    (`consistent="project"` changes only what `M` does not see, `"check"` refuses); with
    `diffrax.diffeqsolve` call [`consistent_state`][.consistent_state] first, or the solve ends
    at once with `RESULTS.nonlinear_divergence`.

    **Raises:**

    `TypeError` and `ValueError` for masses or `controlled` of another kind or shape.

    Source: Hairer & Wanner, Solving ODEs II, chapter VI (index 1), VI.6 for masses that depend on
    the state.
    """

    vector_field: Callable[[RealScalarLike, Y, Args], Y]
    mass: Any
    # Which numbers of a diagonal are zero, packed, if that was known outside of compiled programs.
    packed_massless: bytes | None = eqx.field(static=True)
    packed_controlled: bytes | None = eqx.field(static=True)

    def __init__(
        self,
        vector_field: Callable[[RealScalarLike, Y, Args], Y],
        mass: Any,
        *,
        controlled: np.ndarray | None = None,
    ):
        check_function("vector_field", vector_field, "f(t, y, args)")
        if callable(mass):
            check_function("mass", mass, "M(t, y, args)")
        else:
            _check_numbers(mass)
        self.vector_field = vector_field
        self.mass = mass
        self.packed_massless = _packed_massless(mass)
        self.packed_controlled = None if controlled is None else _packed_controlled(controlled)

    def vf(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        return self.vector_field(t, y, args)

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs: Any) -> RealScalarLike:
        return t1 - t0

    def prod(self, vf: Any, control: RealScalarLike) -> NoReturn:
        """Return the increment for solvers that do not know of mass matrices."""
        raise ValueError(
            "`terms` is an `mj.MassMatrixTerm`, whose mass matrix this solver would ignore. Use `mj.Rodas5P()`, "
            "`mj.Rodas3P()` or `mj.RadauIIA5()`, alone or in `mj.Projected`. For another solver and a regular mass matrix solve for y' in "
            "the vector field of a `diffrax.ODETerm`."
        )

    def consistent_state(
        self, t: RealScalarLike, y: Y, args: Args = None, *, throw: bool = True
    ) -> tuple[Y, ProjectionInfo]:
        """An initial value that satisfies the algebraic equations at time `t`.

        Newton's method for the part of `y` that `M` does not see, from `y`; `M y` is kept (with
        constant `M`). A consistent state is returned unchanged. Differentiable.

        **Returns:**

        `(y, info)`, with `info.correction` the largest `|change| / (|y| + 1)`, `info.full_rank`
        whether the index is 1 there, and `info.success`.

        **Raises:**

        With `throw=True` a `RuntimeError` where there is no such state near `y`, or the index is
        above 1.
        """
        return _consistent_state(self, t, y, args, throw)

    def derivative(self, t: RealScalarLike, y: Y, args: Args = None) -> Y:
        """Return `y'` at a consistent state; not finite where the index is above 1."""
        x, unravel = jfu.ravel_pytree(y)
        equations = self.equations(y, args).with_sparsity("auto", t, x)
        return unravel(equations.at(t, x).derivative)

    def equations(self, y: Y, args: Args) -> MassMatrixEquations:
        """Return the equations in the vector of all numbers of the state; `y` is an example of a state."""
        _, unravel = jfu.ravel_pytree(y)

        def field(t: RealScalarLike, x: Float[Array, " n"]) -> Float[Array, " n"]:
            return ravelled_like(y, self.vector_field(t, unravel(x), args))

        mass = lambda t, x: mass_values(self.mass, t, unravel(x), args)
        return MassMatrixEquations(field, mass, self.massless(jfu.ravel_pytree(y)[0].size))

    def massless(self, n: int) -> np.ndarray | None:
        """Return which of the `n` numbers on the diagonal are zero, `None` if that is not known."""
        if self.packed_massless is None:
            return None
        known = unpacked(self.packed_massless)
        return np.broadcast_to(known, (n,)) if known.size in (1, n) else None

    def counted_error(self, error: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the error of a step, zero where it does not count."""
        if self.packed_controlled is None:
            return error
        counts = unpacked(self.packed_controlled)
        if counts.shape != error.shape:
            raise ValueError(
                f"`controlled` must have shape ({error.size},), a boolean for each number of y, got {counts.shape}."
            )
        return jnp.where(counts, error, 0)


def _packed_massless(mass: Any) -> bytes | None:
    """Pack the zeros of numbers on a diagonal, if they are known, behind the number of bits that complete
    the last byte."""
    leaves = jtu.tree_leaves(mass)
    is_matrix = len(leaves) == 1 and leaves[0] is mass and np.ndim(mass) == 2
    if callable(mass) or is_matrix or any(isinstance(x, jax.core.Tracer) for x in leaves):
        return None
    return packed(np.concatenate([np.ravel(np.asarray(leaf)) == 0 for leaf in leaves]))


def _packed_controlled(controlled: Any) -> bytes:
    if isinstance(controlled, jax.core.Tracer):
        raise TypeError(
            "`controlled` must be known outside of compiled programs: use NumPy for it."
        )
    counts = np.asarray(controlled)
    if counts.dtype != bool or counts.ndim != 1 or not counts.any():
        raise ValueError(
            "`controlled` must be a vector of booleans, some of them true, one for each number of y, got "
            f"{counts.dtype} of shape {counts.shape}."
        )
    return packed(counts)


@clear_errors
@numbers_as_arrays("y", "args", times=("t",))
@eqx.filter_jit
def _consistent_state(
    term: MassMatrixTerm, t: RealScalarLike, y: Y, args: Args, throw: bool
) -> tuple[Y, ProjectionInfo]:
    check_state(y, "y")
    y = jtu.tree_map(jnp.asarray, y)
    x, unravel = jfu.ravel_pytree(y)
    equations = term.equations(y, args).with_sparsity("auto", t, x)
    x, info = consistent(equations, t, x)
    y = unravel(x)
    if throw:
        y = Diagnosis(*faults_of_start(info)).raise_unless(info.success, y, "y")
    return y, info


def ravelled_like(y: Y, value: Any) -> Float[Array, " n"]:
    """Return the result of a vector field as a vector; refuse one that is not like the state."""
    if not are_alike(value, y):
        raise ValueError(
            f"`vector_field` must return what `y` is made of, arrays of the shapes {shapes(y)}, got {shapes(value)}."
        )
    check_field_is_real(value, y)
    return _ravelled(y, value)


def _ravelled(y: Y, value: Any) -> Float[Array, " n"]:
    cast = lambda leaf, v: jnp.asarray(v, jnp.result_type(leaf))
    return jfu.ravel_pytree(jtu.tree_map(cast, y, value))[0]


def mass_values(mass: Any, t: RealScalarLike, y: Y, args: Args) -> Float[Array, "..."]:
    """Return the mass as a scalar, a diagonal `(n,)` or a matrix `(n, n)`."""
    if callable(mass):
        mass = mass(t, y, args)
        _check_numbers(mass)
    x, _ = jfu.ravel_pytree(y)
    n = x.size
    if eqx.is_array_like(mass) and jnp.shape(mass) in ((), (n,), (n, n)):
        return jnp.asarray(mass, x.dtype)
    if are_alike(mass, y):
        return _ravelled(y, mass)
    raise ValueError(
        f"`mass` must be a scalar, a diagonal of shape ({n},) or of the shapes of y, or a matrix of shape ({n}, {n}) "
        f"for y of {n} numbers of shapes {shapes(y)}, got {shapes(mass)}."
    )


def _check_numbers(mass: Any) -> None:
    leaves = jtu.tree_leaves(mass)
    for leaf in leaves:
        if not eqx.is_array_like(leaf) or jnp.issubdtype(
            jnp.result_type(leaf), jnp.complexfloating
        ):
            kind = jnp.result_type(leaf) if eqx.is_array_like(leaf) else type(leaf).__name__
            raise TypeError(
                "`mass` must be made of real numbers: a scalar, a diagonal, a matrix, or a callable `M(t, y, args)` "
                f"that returns one, got {kind}."
            )
    if not leaves:
        raise TypeError("`mass` is empty. Without a mass matrix use `diffrax.ODETerm(f)`.")
