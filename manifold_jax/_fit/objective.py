"""Residuals and losses of all pieces, and their derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._adjoint import StepReplayAdjoint
from .._base.types import FloatScalar
from .model import Piece, Prediction, Simulator
from .parameters import Transform


Unknowns: TypeAlias = Float[Array, " N"]


class Objective(eqx.Module):
    """The residuals and losses of a fit.

    The unknowns are one vector: those of the `p` parameters, then `d` tangent coordinates for each
    initial state in `free`. `joints` are the pieces that continue in the next one; their gaps `c` enter
    as `stiffness (c + shift)`, an augmented Lagrangian.

    `penalty` stands for every residual of a piece whose solve failed. It is a constant, larger than any
    residual at the start: a step that makes solves fail is rejected, a trajectory that always fails has
    no influence.
    """

    simulator: Simulator
    pieces: Piece
    free: Any
    joints: Any
    stiffness: Any
    shift: Any
    penalty: Any
    loss: Callable | None
    unravel: Callable = eqx.field(static=True)
    reverse: bool = eqx.field(static=True)

    @property
    def transform(self) -> Transform:
        return self.simulator.transform

    def chosen(self, u: Unknowns, batch: Any = None) -> tuple[Any, Piece]:
        """Return the unknowns of each piece, `(pieces, p + d)`, and the pieces: all, or some."""
        p, d = self.transform.start.size, self.pieces.basis.shape[-1]
        z = jnp.zeros((self.pieces.start.size, d), u.dtype)
        z = z.at[self.free].set(u[p:].reshape(self.free.size, d))
        x = jnp.concatenate([jnp.tile(u[:p], (z.shape[0], 1)), z], axis=1)
        if batch is None:
            return x, self.pieces
        return jtu.tree_map(lambda leaf: leaf[batch], (x, self.pieces))


class Solved(NamedTuple):
    """Predictions of all pieces and their derivatives with respect to the `p + d` unknowns of each: the
    number of sweeps is that of one piece, whatever the number of unknowns in all."""

    values: Prediction
    matrices: Prediction | None

    def around(self, u: Unknowns, objective: Objective, batch: Any = None) -> Prediction:
        """Return the predictions as a function of `u` that can be differentiated (once)."""
        x, _ = objective.chosen(u, batch)
        step = x - jax.lax.stop_gradient(x)
        moved = lambda v, M: v + jax.vmap(jnp.matmul)(M, step)
        return jtu.tree_map(moved, self.values, self.matrices)


def solve(u: Unknowns, objective: Objective, batch: Any = None) -> Solved:
    """Solve all pieces, or those of a batch. Failed ones give zeros, which enter no derivative."""
    x, pieces = objective.chosen(jax.lax.stop_gradient(u), batch)

    def one(x: Any, piece: Piece) -> Solved:
        def twice(x: Any) -> Any:
            out = objective.simulator.predict(x, piece, dfx.ForwardMode())
            return out, out

        matrices, out = jax.jacfwd(twice, has_aux=True)(x)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(M)) for M in matrices]))
        failed = (out.failed > 0) | ~finite
        solved = jtu.tree_map(lambda leaf: jnp.where(failed, 0, leaf), Solved(out, matrices))
        return eqx.tree_at(lambda s: s.values.failed, solved, failed.astype(x.dtype))

    return _each(one, x, pieces)


def _each(function: Callable, x: Any, pieces: Piece) -> Any:
    """Evaluate a function for every piece. A batch of a single piece would take half as long again to
    trace, and would execute both branches of every condition."""
    if x.shape[0] > 1:
        return jax.vmap(function)(x, pieces)
    one = function(*jtu.tree_map(lambda leaf: leaf[0], (x, pieces)))
    return jtu.tree_map(lambda leaf: leaf[None], one)


def gaps(objective: Objective, predicted: Prediction) -> Float[Array, "joints d"]:
    """Return the gaps from the end of a piece to the start of the next, along the manifold there."""
    j = objective.joints
    jump = predicted.end[j] - predicted.begin[j + 1]
    gap = jnp.sum(objective.pieces.basis[j + 1] * jump[:, :, None], axis=1)
    broken = (predicted.failed[j] + predicted.failed[j + 1]) > 0
    return jnp.where(broken[:, None], 0, gap)


def weighted(objective: Objective, predicted: Prediction) -> Float[Array, "pieces L k"]:
    """Return the residuals in units of `sigma`."""
    pieces = objective.pieces
    r = pieces.weights * (predicted.observed - pieces.data)
    penalty = jnp.where(pieces.weights > 0, objective.penalty, 0)
    return jnp.where(predicted.failed[:, None, None] > 0, penalty, r)


class LinearizedResiduals(NamedTuple):
    """Weighted residuals, the gaps, and their derivatives; the slopes `d theta / d u`."""

    r: Float[Array, "pieces L k"]
    J: Float[Array, "pieces L k N"]
    gaps: Float[Array, "joints d"]
    C: Float[Array, "joints d N"]
    slopes: Float[Array, " p"]


@eqx.filter_jit
def linearize(u: Unknowns, solved: Solved, objective: Objective) -> LinearizedResiduals:
    def both(u: Any) -> Any:
        predicted = solved.around(u, objective)
        out = weighted(objective, predicted), gaps(objective, predicted)
        return out, out

    (J, C), (r, c) = jax.jacfwd(both, has_aux=True)(u)
    slopes = jax.jvp(objective.transform.values, (u,), (jnp.ones_like(u),))[1]
    return LinearizedResiduals(r, J, c, C, slopes)


def stacked(u: Any, solved: Solved, objective: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian `(n, N)` and the residuals `(n,)`, both of the data and of the joints."""
    linear = jtu.tree_map(np.asarray, linearize(u, solved, objective))
    weight, N = np.asarray(objective.stiffness), u.size
    J = np.concatenate([linear.J.reshape(-1, N), weight * linear.C.reshape(-1, N)])
    gaps = weight * (linear.gaps + np.asarray(objective.shift))
    return J, np.concatenate([linear.r.ravel(), gaps.ravel()])


def residuals(u: Unknowns, objective: Objective) -> tuple[Any, Any]:
    """Return the residuals of data and joints for least-squares solvers; then the loss and all pieces."""
    solved = solve(u, objective)
    predicted = solved.around(u, objective)
    r = weighted(objective, predicted)
    c = objective.stiffness * (gaps(objective, predicted) + objective.shift)
    return (r, c), (0.5 * (jnp.sum(r * r) + jnp.sum(c * c)), solved)


def total_loss(u: Unknowns, objective: Objective, batch: Any = None) -> tuple[FloatScalar, Any]:
    """Return the loss for minimizers: the sum over records, or the mean over a batch; then as
    `residuals`."""
    x, pieces = objective.chosen(u, batch)
    if objective.reverse:
        one = lambda x, piece: _backwards(x, (piece, objective.simulator))
        predicted = _each(one, x, pieces)
        solved = Solved(predicted, None)
    else:
        solved = solve(u, objective, batch)
        predicted = solved.around(u, objective, batch)
    losses = jax.vmap(lambda *a: _own_loss(objective, *a))(
        predicted.observed, pieces.data, pieces.weights
    )
    counts = jnp.sum(pieces.weights > 0, axis=(1, 2)).astype(losses.dtype)
    bad = (predicted.failed > 0) | ~jnp.isfinite(losses)
    losses = jnp.where(bad, 0.5 * objective.penalty**2 * counts, losses)
    loss = jnp.sum(losses) if batch is None else jnp.mean(losses)
    return loss, (loss, solved)


def _own_loss(objective: Objective, observed: Any, data: Any, weights: Any) -> FloatScalar:
    if objective.loss is None:
        return 0.5 * jnp.sum(jnp.square(weights * (observed - data)))
    loss = objective.loss(*(jax.vmap(objective.unravel)(a) for a in (observed, data, weights)))
    if jnp.shape(loss) != ():
        raise ValueError(
            "`loss(prediction, data, weights)` must return one number for each record, got shape "
            f"{jnp.shape(loss)}. Sum over times and components."
        )
    return loss


@eqx.filter_custom_vjp
def _backwards(x: Any, rest: Any) -> Prediction:
    """Differentiate with respect to many unknowns: one reverse sweep instead of many forward sweeps."""
    piece, simulator = rest
    return simulator.predict(x, piece, StepReplayAdjoint())


@_backwards.def_fwd
def _backwards_fwd(perturbed: Any, x: Any, rest: Any) -> Any:
    del perturbed
    piece, simulator = rest
    out, pullback = jax.vjp(lambda x: simulator.predict(x, piece, StepReplayAdjoint()), x)
    return out, (pullback, out)


@_backwards.def_bwd
def _backwards_bwd(kept: Any, cotangent: Any, perturbed: Any, x: Any, rest: Any) -> Any:
    """Replace a zero cotangent, which a failed solve would turn into NaN."""
    del perturbed, x, rest
    pullback, out = kept
    given = zip(out, cotangent, strict=True)
    (slope,) = pullback(Prediction(*(jnp.zeros_like(o) if c is None else c for o, c in given)))
    return jnp.where(out.failed > 0, 0, slope)
