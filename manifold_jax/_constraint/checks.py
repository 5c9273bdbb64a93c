"""Checks of states and constraints while tracing."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import Args, RealScalarLike, Y
from .constraint import AbstractConstraint, NoConstraint


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
    check_leaves(y, name)
    for leaf in leaves:
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
        if jnp.finfo(dtype).bits < 32:
            raise TypeError(
                f"`{name}` has a leaf of type {dtype}, whose two or three digits are too few for points on a manifold. "
                f"Convert it: `{name} = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), {name})`."
            )


def check_leaves(y: Y, name: str) -> None:
    for leaf in jtu.tree_leaves(y):
        if not eqx.is_array_like(leaf):
            raise TypeError(
                f"`{name}` must be a pytree of real arrays, but has a leaf of type {type(leaf).__name__}."
            )


def check_field_is_real(field: Any, y: Y) -> None:
    """Refuse a complex vector field of a real state, like it in structure: imaginary parts would be lost."""
    is_complex = lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.complexfloating)
    pairs = zip(jtu.tree_leaves(field), jtu.tree_leaves(y), strict=True)
    if any(is_complex(value) and not is_complex(leaf) for value, leaf in pairs):
        raise TypeError(
            "The vector field in `terms` returns complex numbers for a real `y0`. Make the real and the imaginary "
            "parts components of the state: pass e.g. `y0=(z.real, z.imag)`, and return the derivatives of both."
        )


def _is_list_of_numbers(node: Any) -> bool:
    is_number = lambda x: eqx.is_array_like(x) and jnp.ndim(x) == 0
    return isinstance(node, list) and len(node) > 0 and all(map(is_number, node))


def check_constraint_type(constraint: Any, call: str) -> None:
    """Refuse what is not a constraint; `call` is how the function that it was given to is called."""
    if isinstance(constraint, AbstractConstraint):
        return
    got = f"`constraint` must be an `mj.Constraint`, got {type(constraint).__name__}."
    if isinstance(getattr(constraint, "constraint", None), AbstractConstraint):
        raise TypeError(f"{got} Pass its manifold: `system.constraint`.")
    if callable(constraint):
        raise TypeError(f"{got} Wrap a residual function: `mj.Constraint(lambda t, y, args: ...)`.")
    raise TypeError(f"{got} The order of the arguments is `mj.{call}`.")


def as_constraint(constraint: AbstractConstraint | None, call: str) -> AbstractConstraint:
    """Return the manifold, which is all of the state space without a constraint."""
    if constraint is None:
        return NoConstraint()
    check_constraint_type(constraint, call)
    return constraint


def has_no_equations(constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args) -> bool:
    """Whether every state satisfies the constraint. For a constraint that cannot be evaluated
    [`check_constraint`][] raises with the reason."""
    try:
        leaves = jtu.tree_leaves(eqx.filter_eval_shape(constraint, t, y, args))
    except Exception:
        return False
    return len(leaves) > 0 and all(getattr(leaf, "size", 1) == 0 for leaf in leaves)


def check_constraint(constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args) -> int:
    """Refuse, while tracing, constraints of the wrong shape. Returns `m`."""
    if isinstance(constraint, NoConstraint):
        return 0
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
    if not leaves:
        raise ValueError("`constraint` returned no residual at all: is its `return` missing?")
    m = sum(leaf.size if isinstance(leaf, jax.ShapeDtypeStruct) else 1 for leaf in leaves)
    n = sum(jnp.size(leaf) for leaf in jtu.tree_leaves(y))
    if m == 0:
        raise ValueError(
            "`constraint` returned an empty residual; without constraints use the solver alone, or `mj.diffeqsolve`, "
            "which does so."
        )
    if m > n and not constraint.redundant:
        raise ValueError(
            f"`constraint` returned {m} residuals for a state of {n} numbers; at most {n} independent "
            "equations can hold. Remove dependent rows (of a symmetric matrix equation keep the upper triangle), "
            "or pass `redundant=True`."
        )
    return m
