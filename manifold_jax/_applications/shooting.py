"""Multiple shooting on a manifold: charts at the knots, the intervals between them, and their derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.compat import is_okay
from .._base.types import FloatScalar, RealScalarLike, Y
from .._constraint.constraint import AbstractConstraint
from .._constraint.project import consistent_state
from .._constraint.residual import residual_vector
from .._solve import diffeqsolve
from .._solver import Projected


_DEPENDENT = 1e-9


class LinearInputs(eqx.Module):
    """A vector field whose `args` are inputs, linear in time over an interval."""

    term: dfx.ODETerm
    times: Float[Array, " 2"]
    values: Float[Array, "2 m"]

    def at(self, t: RealScalarLike) -> Float[Array, " m"]:
        part = (t - self.times[0]) / (self.times[1] - self.times[0])
        return (1 - part) * self.values[0] + part * self.values[1]

    def __call__(self, t: RealScalarLike, y: Y, args: Any) -> Y:
        del args
        return self.term.vf(t, y, self.at(t))


class Shooting(eqx.Module):
    """How an interval is solved: in `steps` equal steps, an even number. `cost` is a rate; `last` returns the
    final cost and the residual of the goal, one vector; `path` what must not be positive at the knots."""

    term: dfx.ODETerm
    constraint: AbstractConstraint
    solver: dfx.AbstractSolver
    cost: Callable
    last: Callable[[Y], Float[Array, " r"]]
    path: Callable[[RealScalarLike, Y, Array], Float[Array, " s"]]
    unravel: Callable[[Array], Y] = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def solve(
        self, times: Float[Array, " 2"], x: Float[Array, " n"], inputs: Float[Array, "2 m"]
    ) -> tuple[Float[Array, " n"], FloatScalar]:
        """Return the state at the end of an interval and the integral of the cost by Simpson's rule, NaN
        where the solve fails."""
        field = LinearInputs(self.term, times, inputs)
        ts = times[0] + (times[1] - times[0]) * np.linspace(0, 1, self.steps + 1)
        sol = diffeqsolve(
            *(dfx.ODETerm(field), Projected(self.solver, self.constraint)),
            *(ts[0], ts[-1], None, self.unravel(x), inputs[0]),
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=dfx.StepTo(ts),
            max_steps=self.steps,
            adjoint=dfx.ForwardMode(),
            throw=False,
            consistent="assume",
        )
        rate = lambda t, y: jnp.asarray(self.cost(t, y, field.at(t)), ts.dtype)
        rates = jax.vmap(rate)(ts, sol.ys)
        weights = np.array([1, *[4, 2] * (self.steps // 2 - 1), 4, 1]) / 3
        cost = (ts[1] - ts[0]) * (weights @ rates)
        end = jfu.ravel_pytree(jtu.tree_map(lambda leaf: leaf[-1], sol.ys))[0]
        good = is_okay(sol.result)
        return jnp.where(good, end, jnp.nan), jnp.where(good, cost, jnp.nan)

    @eqx.filter_jit
    def jacobians(
        self, ts: Float[Array, " K"], xs: Float[Array, "K n"], us: Float[Array, "K m"]
    ) -> Float[Array, "K r n"]:
        """Return the Jacobians of the constraint."""
        g = lambda x, t, u: residual_vector(self.constraint, t, self.unravel(x), u)
        return jax.vmap(jax.jacrev(g))(xs, ts, us)


class Charts(NamedTuple):
    """Tangent coordinates at `K` knots: `z` stands for `center + basis z`, corrected onto the manifold."""

    ts: Float[Array, " K"]
    centers: Float[Array, "K n"]
    bases: Float[Array, "K n d"]

    @staticmethod
    def around(
        shooting: Shooting, ts: Any, xs: Any, us: Any, dimension: int | None = None
    ) -> "Charts":
        """Return charts around states on the manifold, whose dimension is found if it is not given."""
        given = map(jnp.asarray, (ts, xs, us))
        _, sizes, right = np.linalg.svd(np.asarray(shooting.jacobians(*given)))
        independent = sizes > _DEPENDENT * sizes.max(axis=1, initial=0, keepdims=True)
        rank = int(independent.sum(axis=1).max(initial=0))
        rank = rank if dimension is None else right.shape[1] - dimension
        bases = np.swapaxes(right[:, rank:], 1, 2)
        return Charts(*map(jnp.asarray, (ts, xs, bases)))

    def closed(self) -> "Charts":
        """Return the same with the chart of the first knot at the last one."""
        centers, bases = (x.at[-1].set(x[0]) for x in (self.centers, self.bases))
        return Charts(self.ts, centers, bases)


class Knots(NamedTuple):
    """The states at all knots, and their derivatives by the tangent coordinates."""

    x: Float[Array, "K n"]
    by_z: Float[Array, "K n d"]


class IntervalEnds(NamedTuple):
    """The states reached at the ends of all intervals, with the cost as the last component, and their derivatives
    by `p`: the coordinates of the first knot and the inputs at both."""

    reached: Float[Array, "K_1 n_1"]
    by_p: Float[Array, "K_1 n_1 p"]


class AtTheEnd(NamedTuple):
    """The final cost and the residual of the goal, and their derivatives by the coordinates of the knot."""

    values: Float[Array, " r"]
    by_z: Float[Array, "r d"]


class AtTheKnots(NamedTuple):
    """What must not be positive at all knots, and its derivatives by their coordinates and inputs."""

    values: Float[Array, "K s"]
    by_z: Float[Array, "K s d"]
    by_u: Float[Array, "K s m"]


@eqx.filter_jit
def states_at(
    shooting: Shooting, charts: Charts, z: Float[Array, "K d"], u: Float[Array, "K m"]
) -> Knots:
    """Return the states with these coordinates, NaN where there are none."""

    def state(z: Array, t: Array, center: Array, basis: Array, u: Array) -> tuple[Array, Array]:
        near = shooting.unravel(center + basis @ z)
        y, info = consistent_state(shooting.constraint, t, near, u, throw=False)
        x = jnp.where(info.success, jfu.ravel_pytree(y)[0], jnp.nan)
        return x, x

    by_z, x = jax.vmap(jax.jacfwd(state, has_aux=True))(z, *charts, u)
    return Knots(x, by_z)


@eqx.filter_jit
def solve_intervals(
    shooting: Shooting,
    times: Float[Array, "K_1 2"],
    knots: Knots,
    inputs: Float[Array, "K_1 2 m"],
) -> IntervalEnds:
    """Solve all intervals at once, with first derivatives in forward mode."""
    d = knots.by_z.shape[2]

    def interval(p: Array, times: Array, knot: Knots, inputs: Array) -> tuple[Array, Array]:
        change = p[d:].reshape(inputs.shape)
        out = jnp.append(*shooting.solve(times, knot.x + knot.by_z @ p[:d], inputs + change))
        return out, out

    zero = jnp.zeros((times.shape[0], d + inputs[0].size), inputs.dtype)
    by_p, reached = jax.vmap(jax.jacfwd(interval, has_aux=True))(zero, times, knots, inputs)
    return IntervalEnds(reached, by_p)


@eqx.filter_jit
def solve_last(shooting: Shooting, x: Float[Array, " n"], by_z: Float[Array, "n d"]) -> AtTheEnd:
    last = lambda z: shooting.last(shooting.unravel(x + by_z @ z))
    at = jnp.zeros(by_z.shape[1], x.dtype)
    return AtTheEnd(last(at), jax.jacfwd(last)(at))


@eqx.filter_jit
def path_at(
    shooting: Shooting, ts: Float[Array, " K"], knots: Knots, u: Float[Array, "K m"]
) -> AtTheKnots:
    """Return the path constraint at all knots."""

    def path(z: Array, u: Array, t: Array, knot: Knots) -> Float[Array, " s"]:
        return shooting.path(t, shooting.unravel(knot.x + knot.by_z @ z), u)

    zero = jnp.zeros((u.shape[0], knots.by_z.shape[2]), u.dtype)
    by_z, by_u = jax.vmap(jax.jacfwd(path, argnums=(0, 1)))(zero, u, ts, knots)
    return AtTheKnots(jax.vmap(path)(zero, u, ts, knots), by_z, by_u)
