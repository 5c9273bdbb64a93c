r"""Coordinates in the algebra of a Lie group (Runge-Kutta-Munthe-Kaas methods)."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

import manifold_jax as mj

from .group import AbstractLieGroup


class LieGroupChart(mj.AbstractChart):
    r"""Exact coordinates on Lie groups for [`LocalCoordinates`][]: a step begins at $y_0$ and is made
    for `w` in the algebra,

    $$y = y_0\,\phi(w), \qquad w' = d\phi_w^{-1}(\xi), \quad \xi = y^{-1} f(t, y), \quad w(t_0) = 0,$$

    with the exponential or Cayley's map $\phi$. The order of the wrapped solver is preserved.

    ```python
    def field(t, y, args):
        attitude, velocity = y
        return mj.UnitQuaternion().tangent(attitude, velocity), torque(t, y, args)

    constraint = mj.Product((mj.Sphere(), None))
    chart = mj.LieGroupChart((mj.UnitQuaternion(), None))
    solver = mj.LocalCoordinates(dfx.Tsit5(), constraint, chart=chart)
    ```

    No equations are solved unless the constraint has others than those of the groups, on which
    every stage is. Ordinary differential equations only, with a field that is tangent.

    **Arguments:**

    - `groups`: like the state, or like the upper part of its tree: [`SO3`][], [`SE3`][],
        [`UnitQuaternion`][] or another [`AbstractLieGroup`][] for each part, `None` for
        ordinary components.
    - `coordinates`: `"exponential"`, with which steps of more than half a turn are rejected, or
        `"cayley"`, which needs no sines and cannot reach half a turn.

    Prefer [`Projected`][], which is cheaper and about as accurate, unless the field is defined on
    the group only or turns fast: uniform rotations are exact in these coordinates.

    Source: Munthe-Kaas, Appl. Numer. Math. 29 (1999) 115-127; Iserles, Munthe-Kaas, Norsett &
    Zanna, Acta Numerica 9 (2000) 215-365.
    """

    groups: Any
    coordinates: Literal["exponential", "cayley"] = eqx.field(static=True, default="exponential")

    def __check_init__(self):
        if self.coordinates not in ("exponential", "cayley"):
            raise ValueError(
                f"`coordinates` must be 'exponential' or 'cayley', got {self.coordinates!r}."
            )
        leaves = jtu.tree_leaves(self.groups, is_leaf=_is_group)
        if not all(map(_is_group, leaves)) or not any(leaf is not None for leaf in leaves):
            raise TypeError(
                "`groups` must be like the state, with e.g. `mj.SO3()` or `mj.UnitQuaternion()` for its parts and "
                f"None for ordinary ones, got {self.groups!r}."
            )

    def at(self, constraint, projection, t, y, args) -> "_LieCoordinates":
        origin = [
            y if group is None else jnp.zeros((group.dimension,), y.dtype)
            for group, y in self.parts(y)
        ]
        return _LieCoordinates(
            chart=self, constraint=constraint, projection=projection, centre=y, origin=origin
        )

    @property
    def state(self):
        return self.moved

    def moved(self, y: Any, w: list[Any]) -> Any:
        r"""Return $y_0\,\phi(w)$, part by part; for ordinary components `w` itself."""
        cayley = self.coordinates == "cayley"
        parts = [
            w if group is None else group.moved(y, w, cayley)
            for (group, y), w in zip(self.parts(y), w, strict=True)
        ]
        return jtu.tree_unflatten(jtu.tree_structure(self.groups, is_leaf=_is_group), parts)

    def rate(self, w: list[Any], y: Any, vector: Any) -> list[Any]:
        """Return the velocity of `w` for a velocity of the state `y`."""
        cayley = self.coordinates == "cayley"
        parts = zip(self.parts(y), self.parts(vector), w, strict=True)
        return [
            f if group is None else group.rate(w, group.velocity(y, f), cayley)
            for (group, y), (_, f), w in parts
        ]

    def parts(self, y: Any) -> list[tuple[AbstractLieGroup | None, Any]]:
        groups, structure = jtu.tree_flatten(self.groups, is_leaf=_is_group)
        try:
            parts = list(zip(groups, structure.flatten_up_to(y), strict=True))
        except ValueError:
            parts = None
        # A group acts on one array, not on all arrays in a part of the state.
        if parts is None or not all(group is None or eqx.is_array(y) for group, y in parts):
            raise ValueError(
                f"`groups` of `mj.LieGroupChart` must be like the state, {jtu.tree_structure(y)}, with a group or None "
                f"for each of its arrays, got {self.groups}."
            )
        return parts


class _LieCoordinates(mj.AbstractCoordinates):
    chart: LieGroupChart
    constraint: mj.AbstractConstraint
    projection: mj.NewtonProjection
    centre: Any
    origin: list[Any]

    def lift(self, t, w, args) -> tuple[Any, mj.ProjectionInfo]:
        parts = zip(self.chart.parts(self.centre), w, strict=True)
        cayley = self.chart.coordinates == "cayley"
        within = [group.is_within(w, cayley) for (group, _), w in parts if group is not None]
        within = jnp.all(jnp.stack(within))
        # Replaced before anything is computed with it: the derivative of a NaN is never zero.
        where = lambda a, b: jnp.where(within, a, jax.lax.stop_gradient(b))
        y = self.chart.moved(self.centre, jtu.tree_map(where, w, self.origin))
        y, info = self.constraint.correct(self.projection, t, y, args, fallback=self.centre)
        return y, eqx.tree_at(lambda i: i.success, info, info.success & within)

    def pull_back(self, t, w, y, vector) -> list[Any]:
        return self.chart.rate(w, y, vector)

    def push_forward(self, t, w, y, args, error) -> Any:
        return jax.jvp(lambda w: self.chart.moved(self.centre, w), (w,), (error,))[1]


def _is_group(x: Any) -> bool:
    return x is None or isinstance(x, AbstractLieGroup)
