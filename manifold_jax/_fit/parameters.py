"""Parameters with bounds as functions of unbounded unknowns: `u = 0` at the start, of relative size."""

from typing import Any

import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float


# exp(50) is 5e21 times the start: beyond it there is only overflow.
LARGEST = 50.0


class Transform(eqx.Module):
    r"""The map from `p` unknowns `u` on the whole line to parameters `theta` within their bounds.

    With the start `s`, the lower bound `a` and the upper bound `b`:

    - none: `theta = s + |s| u` (`s + u` where `s = 0`);
    - one: `theta = a + (s - a) exp(u)` or `b - (b - s) exp(-u)`;
    - both: `theta = a + (b - a) sigmoid(u + logit((s - a) / (b - a)))`.
    """

    start: Float[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    names: tuple[str, ...] = eqx.field(static=True)
    unravel: Any = eqx.field(static=True)

    def values(self, u: Float[Array, " N"]) -> Float[Array, " p"]:
        """Return `theta` from the first `p` of all unknowns of a fit."""
        u = u[: self.start.size]
        s, has_a, has_b = self.start, jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        # Selected twice, as the derivative of a discarded infinity would be NaN.
        a, b = jnp.where(has_a, self.lower, s - 1), jnp.where(has_b, self.upper, s + 1)
        v = jnp.clip(u, -LARGEST, LARGEST)
        free = s + jnp.where(s == 0, 1, jnp.abs(s)) * u
        above, below = a + (s - a) * jnp.exp(v), b - (b - s) * jnp.exp(-v)
        middle = jnp.log(s - a) - jnp.log(b - s)
        between = a + (b - a) / (1 + jnp.exp(-(v + middle)))
        return jnp.where(has_a, jnp.where(has_b, between, above), jnp.where(has_b, below, free))

    def parameters(self, u: Float[Array, " N"]) -> Any:
        return self.unravel(self.values(u))


def make_transform(parameters: Any, bounds: Any, positive: Any) -> Transform:
    """Check start values and bounds, and name every number."""
    named = jtu.tree_flatten_with_path(parameters)[0]
    if not named:
        raise ValueError("`parameters` has no numbers in it: pass the start values to fit from.")
    dtype = jnp.result_type(float)
    for path, leaf in named:
        name = jtu.keystr(path, simple=True, separator=".")
        if not eqx.is_array_like(leaf) or np.iscomplexobj(leaf) or np.asarray(leaf).dtype == bool:
            raise TypeError(
                f"`parameters` must be a pytree of real numbers and arrays, but {name or 'it'} is "
                f"of type {type(leaf).__name__}. Keep what is not fitted inside `model`."
            )
        if not np.all(np.isfinite(leaf)):
            raise ValueError(f"`parameters` must start from finite values, but {name} is {leaf}.")
    parameters = jtu.tree_map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    start, unravel = jfu.ravel_pytree(parameters)
    lower, upper = _flat_bounds(parameters, bounds)
    if positive is not False:
        mask = _flat_prefix(positive, parameters, "positive", "True or False") != 0
        lower = np.where(mask, np.maximum(lower, 0.0), lower)
    names = tuple(name for path, leaf in named for name in _entries(path, np.shape(leaf)))
    for name, s, a, b in zip(names, np.asarray(start), lower, upper, strict=True):
        if not a < b:
            raise ValueError(f"`bounds` of {name} are empty: the lower, {a}, is not below {b}.")
        if not a < s < b:
            raise ValueError(
                f"`parameters`: {name} starts at {s}, which is not inside its bounds ({a}, {b}). "
                "Start strictly inside, or widen `bounds` (`positive` is a lower bound of 0)."
            )
    return Transform(start, jnp.asarray(lower, dtype), jnp.asarray(upper, dtype), names, unravel)


def _flat_bounds(parameters: Any, bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    if bounds is None:
        bounds = (-np.inf, np.inf)
    if not isinstance(bounds, tuple) or len(bounds) != 2:
        raise TypeError(
            "`bounds` must be a pair `(lower, upper)`, each a number or like `parameters` "
            "(with -inf and inf where there is none)."
        )
    lower, upper = (_flat_prefix(b, parameters, "bounds", "a number") for b in bounds)
    return lower, upper


def _flat_prefix(prefix: Any, tree: Any, name: str, what: str) -> np.ndarray:
    advice = (
        f"`{name}` must be {what}, or have the structure and shapes of `parameters`, "
        f"{jtu.tree_structure(tree)}."
    )
    return np.concatenate(list(map(np.ravel, jtu.tree_leaves(spread(prefix, tree, advice)))))


def spread(prefix: Any, tree: Any, advice: str) -> Any:
    """Return numbers like those in `tree`, from a tree whose leaves hold for whole parts of it."""
    fill = lambda value, part: jtu.tree_map(
        # With this casting complex numbers raise, and do not lose their imaginary parts.
        lambda leaf: np.broadcast_to(
            np.asarray(value).astype(float, casting="same_kind"), np.shape(leaf)
        ),
        part,
    )
    try:
        return jtu.tree_map(fill, prefix, tree)
    except (ValueError, TypeError) as error:
        raise ValueError(advice) from error


def _entries(path: Any, shape: tuple[int, ...]) -> list[str]:
    name = jtu.keystr(path, simple=True, separator=".") or "parameter"
    indices = list(np.ndindex(*shape))
    return [name + (f"[{', '.join(map(str, i))}]" if i else "") for i in indices]
