"""Projection of vector fields onto the tangent space of the manifold."""

from collections.abc import Callable
from typing import Any

import equinox as eqx

from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.checks import check_constraint_type
from .._constraint.constraint import AbstractConstraint
from .._constraint.settings import NewtonProjection
from .stabilization import InvariantStabilization


class TangentField(eqx.Module):
    """The function `(t, y, args)` that [`tangent_field`][] returns."""

    function: Callable
    constraint: AbstractConstraint
    projection: NewtonProjection

    def __call__(self, t: RealScalarLike, y: Y, args: Args = None) -> Y:
        neutral = InvariantStabilization(0.0, projected=True)
        return neutral.field(self.function, self.constraint, self.projection, 1, t, y, args)


def tangent_field(
    function: Callable,
    constraint: AbstractConstraint,
    *,
    projection: NewtonProjection | None = None,
) -> Callable[[Any, Y, Args], Y]:
    r"""The part of a vector field that is tangent to the manifold:

    $$F = f - G^+ (G f + \partial g / \partial t), \qquad G^+ = V (G V)^{-1}, \quad V = W^{-1} G^T.$$

    ```python
    field = mj.tangent_field(lambda t, y, network: network(y), constraint)
    sol = mj.diffeqsolve(dfx.ODETerm(field), mj.Projected(dfx.Tsit5(), constraint), ...)
    ```

    For fields that know nothing of the constraint: neural networks, noisy or
    simplified models, gradients of the surrounding space. Moving the state back onto the manifold
    after each step is not enough for these: the result would depend on the steps to first order,
    whatever the order of the solver, and adaptive steps become as small as the tolerance over the
    normal part. Not needed where `f` is tangent already, as for equations of motion with their
    conserved quantities and for [`MechanicalSystem`][].

    **Arguments:**

    - `function`: `f(t, y, args)`, like `y`.
    - `constraint`: the manifold; its equations must be independent, or `redundant=True`.
    - `projection`: only its metric `W` is used, by default the identity.

    **Returns:**

    A function `F(t, y, args)` for `diffrax.ODETerm`, a pytree with the leaves of its arguments. One
    Jacobian for each evaluation. NaN where the equations are dependent.

    Source: Ascher, Chin & Reich, Numer. Math. 67 (1994) 131-149, with gain 0.
    """
    advice = "Of a Diffrax term pass its `vector_field`."
    check_function("function", function, "f(t, y, args)", advice=advice)
    check_constraint_type(constraint, "tangent_field(function, constraint)")
    return TangentField(
        function, constraint, NewtonProjection() if projection is None else projection
    )
