"""Products of manifolds, one for each part of the state."""

from typing import Any

import jax.tree_util as jtu

import manifold_jax as mj


class Product(mj.AbstractConstraint):
    """The product of manifolds, each for a part of the state.

    ```python
    constraint = mj.Product((mj.Stiefel(), None))  # y = (attitude, angular velocity)
    ```

    Each part is corrected by itself, in its own way: those with a formula without iteration. (All
    of them together by Newton's method, as any [`Constraint`][], along directions that are given.)

    **Arguments:**

    - `parts`: like the state, or like the upper part of its tree, with a constraint for each part,
        `None` for one that is free. Constraints get their part alone, with `t` and `args`.

    **Raises:**

    `TypeError` for parts that are neither; `ValueError` for states with other parts.
    """

    parts: Any

    def __check_init__(self):
        parts = jtu.tree_leaves(self.parts, is_leaf=_is_part)
        for part in parts:
            if not isinstance(part, mj.AbstractConstraint | None):
                raise TypeError(
                    f"`parts` must have constraints or None as leaves, got {type(part).__name__}. Wrap a residual "
                    "function: `mj.Constraint(lambda t, y, args: ...)`."
                )
        if not any(isinstance(part, mj.AbstractConstraint) for part in parts):
            raise ValueError("`parts` has no constraint.")

    @property
    def redundant(self) -> bool:
        return any(part.redundant for part in jtu.tree_leaves(self.parts, is_leaf=_is_constraint))

    def __call__(self, t: Any, y: Any, args: Any = None) -> Any:
        pairs = zip(*self._parts_of(y), strict=True)
        return [part(t, y, args) for part, y in pairs if part is not None]

    def correct(
        self, projection, t, y, args=None, *, fallback=None, far=False, directions=None
    ) -> tuple[Any, mj.ProjectionInfo]:
        by_parts = projection.metric is None or isinstance(projection.metric, str)
        if directions is not None or not by_parts:
            return super().correct(
                projection, t, y, args, fallback=fallback, far=far, directions=directions
            )
        parts, states = self._parts_of(y)
        _, fallbacks = self._parts_of(y if fallback is None else fallback)
        corrected, infos = [], []
        for part, state, safe in zip(parts, states, fallbacks, strict=True):
            if part is not None:
                state, info = part.correct(projection, t, state, args, fallback=safe, far=far)
                infos.append(info)
            corrected.append(state)
        structure = jtu.tree_structure(self.parts, is_leaf=_is_part)
        return jtu.tree_unflatten(structure, corrected), mj.ProjectionInfo.of_parts(*infos)

    def _parts_of(self, y: Any) -> tuple[list[Any], list[Any]]:
        parts, structure = jtu.tree_flatten(self.parts, is_leaf=_is_part)
        try:
            return parts, structure.flatten_up_to(y)
        except ValueError as error:
            raise ValueError(
                f"`y` must have the parts of `mj.Product({self.parts})`, got {jtu.tree_structure(y)}."
            ) from error


def _is_constraint(x: Any) -> bool:
    return isinstance(x, mj.AbstractConstraint)


def _is_part(x: Any) -> bool:
    return x is None or _is_constraint(x)
