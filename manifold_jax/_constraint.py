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

from ._custom_types import Args, FloatScalar, RealScalarLike, Residual, ResidualFunction, Y


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
    leaves of a callable module, or through a closure; all are differentiated. Any
    units: rows are scaled by `max_j |G_ij| (|y_j| + 1)` before they are compared.

    **Arguments:**

    - `function`: `g(t, y, args)`, returning any pytree of real arrays.

    Use [`Invariants`][] when the constraint is "this quantity keeps its initial
    value".
    """

    function: ResidualFunction
    redundant: ClassVar[bool] = False

    def __check_init__(self):
        if not callable(self.function):
            raise TypeError(
                "Constraint(function) needs a callable `g(t, y, args)`, got "
                f"{type(self.function).__name__}. Write e.g. "
                "`Constraint(lambda t, y, args: y @ y - 1.0)`."
            )

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
        if not callable(function):
            raise TypeError(
                f"Invariants(function) needs a callable `I(t, y, args)`, got {type(function).__name__}."
            )
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
    """
    scale = jnp.max(jnp.abs(G) * (jnp.abs(x) + 1)[None, :], axis=1)
    return jnp.maximum(scale, jnp.finfo(G.dtype).tiny)


def check_state(y: Y, name: str = "y0") -> None:
    """Refuse, while tracing, states that are not pytrees of real floating-point arrays."""
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


def check_constraint(constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args) -> int:
    """Refuse, while tracing, constraints of the wrong type or shape; returns `m`."""
    if not isinstance(constraint, AbstractConstraint):
        raise TypeError(
            f"`constraint` must be an `mj.Constraint`, got {type(constraint).__name__}. "
            "Wrap a residual function: `mj.Constraint(lambda t, y, args: ...)`."
        )
    try:
        out = eqx.filter_eval_shape(constraint, t, y, args)
    except TypeError as error:
        if "cond" not in str(error) and "branch" not in str(error):
            raise
        raise TypeError(
            "`constraint` must return the same number of equations in every branch of `jax.lax.cond` or "
            "`jax.lax.switch`; multiply an equation that is switched off by zero."
        ) from error
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


@eqx.filter_jit
def constraint_violation(
    constraint: AbstractConstraint, t: Any, y: Y, args: Args = None
) -> FloatScalar:
    """How far from the manifold: `max_i |g_i| / scale_i`, `scale_i = max_j |G_ij| (|y_j| + 1)`.

    **Arguments:**

    - `constraint`: the constraint.
    - `t`: a time, or the times of a saved trajectory, shape `(times,)`.
    - `y`: the state, or the saved states with a leading axis of length `times`.
    - `args`: as for the constraint.

    **Returns:**

    One number, the largest over the residuals and over all finite times (the unused
    end of a `SaveAt(steps=True)` buffer is skipped). Round-off is about `1e-16` in
    double precision. For absolute residuals call the constraint itself.
    """
    check_state(y, "y")
    t = jnp.asarray(t)
    if t.ndim > 1:
        raise ValueError(f"`t` must be a scalar or of shape (times,), got shape {t.shape}.")
    if t.ndim == 0:
        return _violation(constraint, t, y, args)
    for leaf in jtu.tree_leaves(y):
        if jnp.shape(leaf)[:1] != t.shape:
            raise ValueError(
                f"`y` must have a leading axis of length {t.shape[0]} as `t` has, got a leaf of shape {jnp.shape(leaf)}."
            )
    violations = jax.vmap(lambda t, y: _violation(constraint, t, y, args))(t, y)
    return jnp.max(jnp.where(jnp.isfinite(t), violations, 0.0), initial=0.0)


def _violation(constraint: AbstractConstraint, t: Array, y: Y, args: Args) -> FloatScalar:
    check_constraint(constraint, t, y, args)
    x, unravel = jfu.ravel_pytree(y)
    r, G = jacobian(lambda x: residual_vector(constraint, t, unravel(x), args), x)
    return jnp.max(jnp.abs(r) / row_scale(G, x))
