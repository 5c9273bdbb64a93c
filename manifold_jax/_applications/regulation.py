"""Linear-quadratic regulators along a trajectory, on the tangent spaces of its manifold."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.numbers import numbers_as_arrays
from .._base.types import RealScalarLike, Y
from .._constraint.checks import as_constraint, check_state
from .._constraint.constraint import AbstractConstraint
from .linearization import linearize
from .riccati import solve_riccati


# The cosine of the largest angle between neighbouring tangent spaces.
_TURNED = 0.5
_DEPENDENT = (
    "`regulate`: at t = {t:.6g} the linearization is not finite: equations of `constraint` depend on each other there (remove "
    "the dependent ones), or the vector field is not finite."
)
_TOO_FEW = (
    "`ts`: from t = {before:.6g} to {t:.6g} the tangent space turns by more than 60 degrees. Give more times, for instance those "
    "of `SaveAt(ts=jnp.linspace(...))`."
)
_NO_EFFECT = (
    "`inputs` have no effect on the motion at any of the times. The `args` of the vector field must be the inputs: a plant such as "
    "`mb.Assembly(..., [mb.Controller(joints, lambda t, y, args: args)])`."
)
_DIVERGED = (
    "The Riccati equation cannot be solved from t = {t:.6g} on backwards: until the next time an unstable motion without cost, "
    "or one that no input reaches, grows too much, or the fastest motions are too fast. Give it `state_weights`, or more times."
)


class Regulator(eqx.Module):
    r"""What [`regulate`][manifold_jax.regulate] returns: the feedback `u = regulator(t, y)` along a trajectory.

    Between the times the gains and the inputs are linear, and the states cubic with the rates of the vector field. Before and
    after them all are those of the first and last.

    **Attributes** at `K` times, for a state of `n` numbers, `m` inputs, and `d` tangent coordinates `z`:

    - `ts`, `ys`, `inputs`: the trajectory.
    - `gains`: `R^-1 B^T S T^T`, shape `(K, m, n)`: they act on differences of states in the order of `ravel_pytree(y)`.
    - `riccati`: `S`, shape `(K, d, d)`. `z^T S z` is what a small deviation costs from there to the end.
    - `bases`: the tangent vectors `T`, orthonormal columns, shape `(K, n, d)`, that turn no more than the
        tangent space does.
    """

    ts: Float[Array, " K"]
    ys: Y
    rates: Float[Array, "K n"]
    inputs: Float[Array, "K m"]
    gains: Float[Array, "K m n"]
    riccati: Float[Array, "K d d"]
    bases: Float[Array, "K n d"]

    def __call__(self, t: RealScalarLike, y: Y) -> Float[Array, " m"]:
        """Return the inputs at the time `t` in the state `y`, shape `(m,)`."""
        k = jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, self.ts.size - 2)
        h = self.ts[k + 1] - self.ts[k]
        s = jnp.clip((t - self.ts[k]) / h, 0, 1)
        between = lambda values: (1 - s) * values[k] + s * values[k + 1]
        states = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(self.ys)
        bend = (1 - s) * self.rates[k] - s * self.rates[k + 1]
        chord = states[k + 1] - states[k]
        cubic = s * (1 - s) * (h * bend + (2 * s - 1) * chord)  # zero at both ends
        difference = jfu.ravel_pytree(y)[0] - between(states) - cubic
        return between(self.inputs) - between(self.gains) @ difference


@numbers_as_arrays("state_weights", "input_weights", "final_weights")
def regulate(
    terms: Any,
    constraint: AbstractConstraint | None,
    ts: Any,
    ys: Y,
    inputs: Any,
    *,
    state_weights: Any,
    input_weights: Any,
    final_weights: Any = 0.0,
) -> Regulator:
    r"""Find the feedback that leads back to a trajectory on a manifold: the linear-quadratic regulator of its
    linearization `z' = A z + B v`, with tangent coordinates `z` and `v = u - u*`, which minimizes

    $$\int_{t_0}^{t_1} (\delta y^T Q\, \delta y + v^T R\, v)\,dt + \delta y(t_1)^T Q_1\, \delta y(t_1), \qquad \delta y = T z,$$

    $$-\dot S = A^T S + S A - S B R^{-1} B^T S + T^T Q\, T, \qquad u = u^* - R^{-1} B^T S\, T^T (y - y^*).$$

    It has `d` coordinates, as many as there are free positions and velocities, whatever the closed loops. For
    a state of rest give it at two times: with `final_weights` from `scipy.linalg.solve_continuous_are` the
    gains are constant.

    ```python
    plant = robot(lambda t, y, args: args)  # an assembly with a Controller whose inputs are `args`
    feedback = mj.regulate(plant.system.terms, plant.system.constraint, sol.ts, sol.ys, torques,
                           state_weights=1.0, input_weights=0.1)
    controlled = robot(lambda t, y, args: feedback(t, y))
    ```

    **Arguments:**

    - `terms`: a `diffrax.ODETerm` whose `args` are the inputs `u`, shape `(m,)`. Other parameters are closed over.
    - `constraint`: the manifold, whose equations are independent, or `None` for all of the state space.
    - `ts`: at least two times, increasing, shape `(K,)`, such as `sol.ts` of `SaveAt(ts=...)`.
    - `ys`: the states at these times, on the manifold, such as `sol.ys`.
    - `inputs`: `u*` at these times, shape `(K, m)`.
    - `state_weights`, `final_weights`: `Q` and `Q_1`: a number, one for each component of the state in the
        order of `ravel_pytree(y)`, or a symmetric matrix `(n, n)`; not negative. Without `final_weights` the
        gains fall to zero at the last time.
    - `input_weights`: `R`, a positive number, `(m,)`, or `(m, m)`.

    **Returns:** a [`Regulator`][]. `A`, `B` and `Q` are means over each interval, for which the Riccati equation
    is solved exactly: the error is of second order in the distance of the times, and none in a state of rest,
    however long the interval is and however fast the free motion grows in it.

    **Raises** `ValueError` for shapes that do not fit, `R` that is not positive, inputs without any effect,
    tangent spaces that turn too far between two times, equations that depend on each other, and unstable
    motions without cost that grow too much between two times. Inside `jit` the gains are NaN where these are
    found from the numbers.

    Feedback from far away, where the linearization does not hold, is another matter: find a new trajectory.

    Source: Anderson & Moore, Optimal Control: Linear Quadratic Methods (1990), ch. 2-3; Anderson, Int. J.
    Control 28 (1978) 295-306 (Riccati equations by doubling); Posa, Kuindersma & Tedrake, ICRA 2016, 1366-1373
    (on the tangent space of constraints).
    """
    constraint = as_constraint(constraint, "regulate(terms, constraint, ts, ys, inputs)")
    ts, ys, inputs = _checked_trajectory(ts, ys, inputs)
    n = sum(leaf[0].size for leaf in jtu.tree_leaves(ys))
    weights = (
        _as_matrix("state_weights", state_weights, n),
        _as_matrix("input_weights", input_weights, inputs.shape[1]),
        _as_matrix("final_weights", final_weights, n),
    )
    _check_weights(*weights)
    regulator, B, cosines = _regulate(terms, constraint, ts, ys, inputs, weights)
    if not isinstance(cosines, jax.core.Tracer):
        _raise_if_unusable(regulator, np.asarray(B), np.asarray(cosines))
    return regulator


@eqx.filter_jit
def _regulate(
    terms: Any, constraint: AbstractConstraint, ts: Array, ys: Y, inputs: Array, weights: Any
) -> tuple[Regulator, Float[Array, "K d m"], Float[Array, " K"]]:
    """Return the regulator, the input matrices, and the cosines of the angles between tangent spaces."""
    Q, R, final = weights
    near = jax.vmap(lambda t, y, u: linearize(terms, constraint, t, y, u))(ts, ys, inputs)
    T, turns, cosines = _aligned(near.basis)
    A = jax.vmap(lambda turn, A: turn.T @ A @ turn)(turns, near.matrix)
    B = jax.vmap(lambda turn, B: turn.T @ B)(turns, near.by_args)
    push = jax.vmap(lambda B: B @ jnp.linalg.solve(R, B.T))(B)
    S = solve_riccati(ts, A, push, jax.vmap(lambda T: T.T @ Q @ T)(T), T[-1].T @ final @ T[-1])
    gains = jax.vmap(lambda T, S, B: jnp.linalg.solve(R, (T @ S @ B).T))(T, S, B)
    gains = jnp.where(jnp.min(cosines) > _TURNED, gains, jnp.nan)
    rates = jax.vmap(lambda t, y, u: jfu.ravel_pytree(terms.vf(t, y, u))[0])(ts, ys, inputs)
    return Regulator(ts, ys, rates, inputs, gains, S, T), B, cosines


def _aligned(
    bases: Float[Array, "K n d"],
) -> tuple[Float[Array, "K n d"], Float[Array, "K d d"], Float[Array, " K"]]:
    """Turn each basis in its tangent space as close to the one before as it comes (polar decomposition): the
    coordinates of tangent vectors that do not turn stay the same. Return bases, turns and cosines."""

    def turned(before: Array, basis: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        left, cosines, right = jnp.linalg.svd(jax.lax.stop_gradient(basis.T @ before))
        turn = left @ right
        return basis @ turn, (basis @ turn, turn, jnp.min(cosines, initial=1))

    return jax.lax.scan(turned, bases[0], bases)[1]


def _checked_trajectory(ts: Any, ys: Any, inputs: Any) -> tuple[Array, Y, Array]:
    check_state(ys, "ys")
    ys = jtu.tree_map(jnp.asarray, ys)
    dtype = jnp.result_type(*jtu.tree_leaves(ys))
    ts, inputs = jnp.asarray(ts, dtype), jnp.asarray(inputs, dtype)
    if ts.ndim != 1 or ts.size < 2:
        raise ValueError(f"`ts` must be at least two times, shape (K,), got shape {ts.shape}.")
    known = np.arange(2.0) if isinstance(ts, jax.core.Tracer) else np.asarray(ts, float)
    if not np.all(known[1:] > known[:-1]):
        raise ValueError("`ts` must be finite and increase from each time to the next.")
    for name, leaf in [("ys", leaf) for leaf in jtu.tree_leaves(ys)] + [("inputs", inputs)]:
        if leaf.ndim == 0 or leaf.shape[0] != ts.size:
            raise ValueError(
                f"`{name}` must have a leading axis for the {ts.size} times of `ts`, got an array of shape {leaf.shape}."
            )
    if inputs.ndim != 2:
        raise ValueError(
            f"`inputs` must have the shape ({ts.size}, m) for m inputs, got {inputs.shape}."
        )
    return ts, ys, inputs


def _as_matrix(name: str, weights: Any, size: int) -> Float[Array, "size size"]:
    weights = jnp.asarray(weights, float)
    if weights.shape not in ((), (size,), (size, size)):
        raise ValueError(
            f"`{name}` must be a number, or have the shape ({size},) or ({size}, {size}), got {weights.shape}."
        )
    if weights.ndim == 2:
        return (weights + weights.T) / 2
    return jnp.diag(jnp.broadcast_to(weights, (size,)))


def _check_weights(
    Q: Float[Array, "n n"], R: Float[Array, "m m"], final: Float[Array, "n n"]
) -> None:
    for name, weights in (("state_weights", Q), ("final_weights", final)):
        if isinstance(weights, jax.core.Tracer):
            continue
        values = np.linalg.eigvalsh(np.asarray(weights))
        if not values.min() >= -1e-9 * np.abs(values).max():
            raise ValueError(
                f"`{name}` must not be negative (a positive semidefinite matrix): there would be no least cost."
            )
    if (
        not isinstance(R, jax.core.Tracer)
        and not float(np.linalg.eigvalsh(np.asarray(R)).min()) > 0
    ):
        raise ValueError(
            "`input_weights` must be positive (a positive definite matrix): an input that costs nothing would be infinite. Write a "
            "small number for inputs that are cheap."
        )


def _raise_if_unusable(regulator: Regulator, B: np.ndarray, cosines: np.ndarray) -> None:
    ts, finite = np.asarray(regulator.ts), np.isfinite(cosines) & np.isfinite(B).all(axis=(1, 2))
    finite &= B.shape[1] > 0  # no direction is left where as many equations as numbers are written
    if not finite.all():
        raise ValueError(_DEPENDENT.format(t=ts[np.argmin(finite)]))
    if not cosines.min() > _TURNED:
        k = int(np.argmin(cosines > _TURNED))
        raise ValueError(_TOO_FEW.format(before=ts[k - 1], t=ts[k]))
    if not np.any(B):
        raise ValueError(_NO_EFFECT)
    S = np.asarray(regulator.riccati)
    solved = np.isfinite(S).all(axis=(1, 2))
    if not solved.all():
        raise ValueError(_DIVERGED.format(t=ts[np.flatnonzero(~solved).max()]))
