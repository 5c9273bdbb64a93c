"""The manifold `{y : g(t, y, args) = 0}`: its residual, Jacobian and row scaling."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from ._custom_types import Args, RealScalarLike, Residual, ResidualFunction, Y
from ._user_function import check_function


class AbstractConstraint(eqx.Module):
    """A manifold given by `m` equations, `g(t, y, args) = 0`.

    Implementations provide `__call__`; everything else (Jacobian, scaling, the
    number of constraints) is derived from it by the functions of this module.
    `redundant` says whether equations may depend on each other.
    """

    redundant: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        """Evaluate the residual.

        **Arguments:**

        - `t`: the time, true time also when integrating backwards.
        - `y`: the state, any pytree of real arrays, `n` numbers in all.
        - `args`: whatever is passed as `args` to `diffeqsolve`.

        **Returns:**

        Any pytree of real arrays, `m <= n` numbers in all, zero on the manifold.
        """


class Constraint(AbstractConstraint):
    """The manifold on which a residual function vanishes, `g(t, y, args) = 0`.

    ```python
    circle = mj.Constraint(lambda t, y, args: y @ y - args.radius**2)
    ```

    The rows of the Jacobian `G = dg/dy` (shape `(m, n)`) must be linearly
    independent near the manifold. Parameters may come through `args`, through the
    leaves of a callable module, or through a closure; all are differentiated. Any units of
    the equations: rows are scaled by `max_j |G_ij| (|y_j| + 1)` before they are compared. States
    should not be much smaller than 1 in theirs, see [`NewtonProjection`][].

    **Arguments:**

    - `function`: `g(t, y, args)`, returning any pytree of real arrays.

    Use [`Invariants`][] when the constraint is "this quantity keeps its initial
    value".
    """

    function: ResidualFunction
    redundant: ClassVar[bool] = False

    def __check_init__(self):
        advice = "Write e.g. `mj.Constraint(lambda t, y, args: y @ y - 1.0)`."
        check_function("function", self.function, "g(t, y, args)", advice=advice)

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return self.function(t, y, args)


class Invariants(AbstractConstraint):
    """Conserved quantities, frozen at their initial values:
    `g(t, y, args) = I(t, y, args) - I(t0, y0, args0)`.

    ```python
    energy = mj.Invariants(lambda t, y, args: hamiltonian(y), y0=y0)
    ```

    **Arguments:**

    - `function`: `I(t, y, args)`, returning any pytree of real arrays.
    - `y0`: the state at which the values are frozen.
    - `t0`: the time at which they are frozen.
    - `args`: the `args` with which they are frozen.

    !!! warning

        The values belong to the `y0` and `args` given here. Build `Invariants`
        *inside* the function that is differentiated or vmapped over `y0` (or `args`);
        otherwise every lane is pulled to the same level set, and the part of the
        derivative normal to the manifold vanishes.

    Source: Shampine, Comp. Math. Appl. 12B (1986) 1287-1296 (conservation laws).
    """

    function: ResidualFunction
    values: Residual
    redundant: ClassVar[bool] = False

    def __init__(
        self, function: ResidualFunction, *, y0: Y, t0: RealScalarLike = 0.0, args: Args = None
    ):
        check_function("function", function, "I(t, y, args)")
        self.function = function
        self.values = jtu.tree_map(jnp.asarray, function(t0, y0, args))

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Residual:
        return jtu.tree_map(jnp.subtract, self.function(t, y, args), self.values)


def residual_vector(
    constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args
) -> Float[Array, " m"]:
    """The residual as one vector, in the floating-point type of the state."""
    flat, _ = jfu.ravel_pytree(constraint(t, y, args))
    return flat


def jacobian(
    residual: Callable[[Float[Array, " n"]], Float[Array, " m"]], x: Float[Array, " n"]
) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
    """Residual and Jacobian at once: `m` pullbacks, the cheap direction as `m <= n`."""
    r, pullback = jax.vjp(residual, x)
    (rows,) = jax.vmap(pullback)(jnp.eye(r.shape[0], dtype=r.dtype))
    return r, rows


def row_scale(G: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    """Typical size of each residual, `max_j |G_ij| (|x_j| + 1)`.

    This is row equilibration (Sudarsan & Keerthi 1998, eqs. (3.3)-(3.4), with the typical
    sizes taken from the state).

    The 1 stands for lengths that the state does not show. With the size of the state in its place
    a third of the points beside a rod of length 1, given as displacements of 1e-3, could not be
    corrected: the residual has rounding errors of 1e-16 whatever the displacements.
    """
    scale = jnp.max(jnp.abs(G) * (jnp.abs(x) + 1)[None, :], axis=1)
    return jnp.maximum(scale, jnp.finfo(G.dtype).tiny)


def as_time(t: RealScalarLike, dtype: Any) -> Array:
    """A time as an array of floating point, also where it was given as a whole number."""
    t = jnp.asarray(t)
    return t if jnp.issubdtype(t.dtype, jnp.floating) else t.astype(dtype)


def check_state(y: Y, name: str = "y0") -> None:
    """Refuse, while tracing, states that are not pytrees of real floating-point arrays."""
    if any(_is_list_of_numbers(node) for node in jtu.tree_leaves(y, is_leaf=_is_list_of_numbers)):
        raise TypeError(
            f"`{name}` has a list of numbers, of which JAX makes as many states as there are numbers. Make it one "
            f"array: `{name} = jnp.array([...], float)`."
        )
    leaves = jtu.tree_leaves(y)
    if len(leaves) == 0:
        raise ValueError(
            f"`{name}` has no array leaves: pass the state as a pytree of real arrays."
        )
    for leaf in leaves:
        if not eqx.is_array_like(leaf):
            raise TypeError(
                f"`{name}` must be a pytree of real arrays, but has a leaf of type {type(leaf).__name__}."
            )
        dtype = jnp.result_type(leaf)
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise TypeError(
                f"`{name}` has a complex leaf ({dtype}). Integrate its real and imaginary parts: "
                f"pass e.g. `{name}=(z.real, z.imag)` and write the vector field and the constraint for them."
            )
        if not jnp.issubdtype(dtype, jnp.floating):
            raise TypeError(
                f"`{name}` has a leaf of type {dtype}, which cannot be moved onto a manifold. "
                f"Convert it: `{name} = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), {name})`."
            )


def _is_list_of_numbers(node: Any) -> bool:
    is_number = lambda x: eqx.is_array_like(x) and jnp.ndim(x) == 0
    return isinstance(node, list) and len(node) > 0 and all(map(is_number, node))


def check_constraint_type(constraint: Any) -> None:
    if isinstance(constraint, AbstractConstraint):
        return
    got = f"`constraint` must be an `mj.Constraint`, got {type(constraint).__name__}."
    if isinstance(getattr(constraint, "constraint", None), AbstractConstraint):
        raise TypeError(f"{got} Pass its manifold: `system.constraint`.")
    if callable(constraint):
        raise TypeError(f"{got} Wrap a residual function: `mj.Constraint(lambda t, y, args: ...)`.")
    raise TypeError(f"{got} The constraint comes first: `(constraint, t, y, args)`.")


def check_constraint(constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args) -> int:
    """Refuse, while tracing, constraints of the wrong type or shape; returns `m`."""
    check_constraint_type(constraint)
    try:
        out = eqx.filter_eval_shape(constraint, t, y, args)
    except Exception as error:
        if isinstance(error, TypeError) and ("cond" in str(error) or "branch" in str(error)):
            raise TypeError(
                "`constraint` must return the same number of equations in every branch of `jax.lax.cond` or "
                "`jax.lax.switch`; multiply an equation that is switched off by zero."
            ) from error
        shapes = jtu.tree_map(jnp.shape, y)
        error.add_note(
            f"This is what `constraint` said of a state of shapes {shapes}. Is it one state, as the function expects "
            "it? Saved states need their times: `mj.constraint_violation(constraint, sol.ts, sol.ys, args)`."
        )
        raise
    leaves = jtu.tree_leaves(out)
    for leaf in leaves:
        if not isinstance(leaf, jax.ShapeDtypeStruct | float):
            raise TypeError(
                "`constraint` must return a pytree of real arrays, but its residual has a leaf of type "
                f"{type(leaf).__name__}. Return e.g. `jnp.stack([g1, g2])`."
            )
        if isinstance(leaf, jax.ShapeDtypeStruct) and not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise TypeError(
                f"`constraint` returned a residual of type {leaf.dtype}; it must be real floating-point. "
                "For complex equations return their real and imaginary parts."
            )
    m = sum(leaf.size if isinstance(leaf, jax.ShapeDtypeStruct) else 1 for leaf in leaves)
    n = sum(jnp.size(leaf) for leaf in jtu.tree_leaves(y))
    if m == 0:
        raise ValueError(
            "`constraint` returned an empty residual; without constraints use the solver alone."
        )
    if m > n and not constraint.redundant:
        raise ValueError(
            f"`constraint` returned {m} residuals for a state of {n} numbers; at most {n} independent "
            "equations can hold. Remove dependent rows (of a symmetric matrix equation keep the upper triangle)."
        )
    return m
