"""A curve `H(x) = 0`: its tangent, its start, the steps along it, and whether they stay on one branch."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, RealScalarLike
from .._constraint.constraint import Constraint
from .._constraint.project import consistent_state
from .._constraint.projection_info import ProjectionInfo
from .._constraint.residual import jacobian
from .._linalg.newton import without_derivative
from .._linalg.pivoted import factorize_by_reduction, reduction
from .._solve import diffeqsolve
from .._solver import Projected


@jax.custom_jvp
def kernel(G: Float[Array, "n k"]) -> Float[Array, " k"]:
    """Return the unit vector `tau` with `G tau = 0` and `det [G; tau^T] > 0`, for `k = n + 1`. NaN
    where `G` does not have full rank."""
    # E G^T = [1; 0], hence G tau = 0 for the last row tau of E; and E [G^T, tau] = [1, *; 0, |tau|^2].
    E, sign = reduction(G.T)
    return sign * E[-1] / jnp.sqrt(jnp.sum(E[-1] ** 2))


@kernel.defjvp
def _kernel_derivative(primals, tangents):
    """Differentiate: `G dtau = -dG tau`, `tau . dtau = 0`."""
    (G,), (dG,) = primals, tangents
    tau = kernel(G)
    system = factorize_by_reduction(jnp.concatenate([G, tau[None]]))
    return tau, system.solve(jnp.append(-dG @ tau, 0 * tau[:1]))


class Curve(eqx.Module):
    """`H(x, args) = 0`, `n` equations in `k = n + 1` unknowns, in the form of a constraint.

    Closed-over arrays of the user's function are leaves, so that it can be differentiated or held
    fixed. `orientation` is 1 or -1.
    """

    function: Callable
    args: Args
    orientation: FloatScalar

    def __call__(self, s: Any, x: Float[Array, " k"], args: Any = None) -> Float[Array, " n"]:
        return self.function(x, self.args)

    def tangent(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """Return the unit vector `tau` with `G tau = 0` and `det [G; tau^T]` of the sign of the
        orientation, `G = DH(x)`. Smooth also where the curve folds; changes sign where another branch
        crosses. NaN where `G` does not have full rank.

        Source: Allgower & Georg, Definition 2.1.7 and Lemma 2.1.3.
        """
        return self.orientation * kernel(jacobian(lambda x: self(0.0, x), x)[1])


class Nodes(NamedTuple):
    """The start and the ends of the accepted steps."""

    s: Float[Array, " nodes"]  # arclength
    x: Float[Array, "nodes k"]
    tangent: Float[Array, "nodes k"]


def start_on(
    curve: Curve, x0: Float[Array, " k"], direction: Float[Array, " k"]
) -> tuple[Curve, Float[Array, " k"], ProjectionInfo, Bool[Array, " 4"]]:
    """Return the curve with its orientation, the point to start from, the report of its correction, and
    the faults: not finite, singular, not on the curve, or no direction."""
    x, info = consistent_state(Constraint(curve), 0.0, x0, throw=False)
    along = direction @ jax.lax.stop_gradient(curve.tangent(x))
    # Perpendicular up to the rounding errors of a point that is itself only near a fold.
    blurred = jnp.finfo(x.dtype).eps ** 0.5 * jnp.sqrt(jnp.sum(direction**2))
    faults = [~jnp.isfinite(info.residual), ~info.full_rank, ~info.success]
    faults = jnp.stack([*faults, ~(jnp.abs(along) > blurred)])
    orientation = jnp.where(along < 0, -1, 1).astype(x.dtype)
    return eqx.tree_at(lambda c: c.orientation, curve, orientation), x, info, faults


def follow(
    curve: Curve,
    start: Float[Array, " k"],
    arclengths: Float[Array, " points"],
    solver: dfx.AbstractSolver,
    options: dict[str, Any],
) -> tuple[dfx.Solution, Nodes]:
    """Solve `dx/ds = tau(x)`; return the values at the arclengths, and the steps."""

    def node(s: Any, x: Float[Array, " k"], args: Any) -> Nodes:
        return without_derivative(Nodes(s, x, curve.tangent(x)))

    saved = dfx.SubSaveAt(ts=arclengths), dfx.SubSaveAt(t0=True, steps=True, fn=node)
    term = dfx.ODETerm(lambda s, x, args: curve.tangent(x))
    sol = diffeqsolve(
        *(term, Projected(solver, Constraint(curve)), arclengths[0], arclengths[-1], None, start),
        saveat=dfx.SaveAt(subs=saved, dense=True),
        throw=False,
        consistent="assume",
        **options,
    )
    return sol, sol.ys[1]  # pyright: ignore[reportOptionalSubscript]


def unbroken(
    nodes: Nodes, rtol: RealScalarLike, atol: RealScalarLike
) -> tuple[IntScalar, BoolScalar]:
    """Return how many nodes belong to one smooth curve, and whether all of them do.

    Near a crossing the steps become as small as the tolerances allow, and the next one may end on any
    of the branches: with the tangent reversed or turned.
    """
    used = jnp.isfinite(nodes.s)
    tolerance = atol + rtol * jnp.max(jnp.abs(nodes.x), axis=1)
    tangents = nodes.tangent[:-1], nodes.tangent[1:]
    turn = jnp.sum(tangents[0] * tangents[1], axis=1)
    chord = jnp.sum((nodes.x[1:] - nodes.x[:-1]) * (tangents[0] + tangents[1]) / 2, axis=1)
    smooth = (turn > 0.5) & (chord > 0.5 * (nodes.s[1:] - nodes.s[:-1]) - tolerance[1:])
    good = jnp.append(True, smooth)
    return jnp.sum(jnp.cumprod(good & used)), jnp.all(good | ~used)
