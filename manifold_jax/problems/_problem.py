"""The class of all problems of the gallery: a vector field on a manifold with a known solution."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.integrate
from jaxtyping import Array

from .._base.types import Args, ResidualFunction, Y
from .._constraint.constraint import AbstractConstraint, Invariants
from .._mechanics import MechanicalSystem
from .._resets.reset import Reset, ResetAt
from .._solver.chart import AbstractChart


def integrate(
    field: Callable[[float, np.ndarray], Sequence[float] | np.ndarray],
    x0: Sequence[float] | np.ndarray,
    t: np.ndarray,
) -> np.ndarray:
    """Solve `x' = field(t, x)` from `x0` at time 0: states of shape `(times, n)` at the times `t`.

    By SciPy's DOP853, as accurate as it can be: for the pendulum (10 s, 5 swings) the error of angle
    and rate is below 2e-13.
    """
    x0 = np.asarray(x0, np.float64)
    states = np.tile(x0, (t.size, 1))
    for side in filter(np.any, (t > 0, t < 0)):
        end = t[side][np.argmax(np.abs(t[side]))]
        solution = scipy.integrate.solve_ivp(
            field, (0.0, end), x0, method="DOP853", rtol=3e-14, atol=1e-15, dense_output=True
        )
        if not solution.success:
            raise ValueError(f"The reference solution does not reach t = {end}: {solution.message}")
        states[side] = solution.sol(t[side]).T
    return states


class _Falls:
    """An event of SciPy that ends an integration where the condition falls through zero."""

    terminal, direction = True, -1

    def __init__(self, condition: Callable[[float, np.ndarray], float]):
        self.condition = condition

    def __call__(self, t: float, x: np.ndarray) -> float:
        return self.condition(t, x)


def integrate_with_resets(
    field: Callable[[float, np.ndarray], Sequence[float] | np.ndarray],
    x0: Sequence[float] | np.ndarray,
    t: np.ndarray,
    conditions: Sequence[Callable[[float, np.ndarray], float]],
    jump: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Solve from time 0 forwards as `integrate` does, restarted with `jump(i, x)` where
    `conditions[i](t, x)` falls through zero. At these times the states are those after the jump."""
    events = [_Falls(condition) for condition in conditions]
    start, end, x = 0.0, float(np.max(t, initial=0.0)), np.asarray(x0, np.float64)
    if np.any(t < 0):
        raise ValueError("The solution with jumps is not known before the start.")
    states = np.tile(x, (t.size, 1))
    while start < end:
        solution = scipy.integrate.solve_ivp(
            field,
            (start, end),
            x,
            method="DOP853",
            rtol=3e-14,
            atol=1e-15,
            dense_output=True,
            events=events,
        )
        inside = t >= start
        states[inside] = solution.sol(np.minimum(t[inside], solution.t[-1])).T
        start, x = solution.t[-1], solution.y[:, -1]
        if solution.status == 1:
            number = next(i for i, times in enumerate(solution.t_events) if times.size)
            x = jump(number, x)
            states[t >= start] = x
    return states


class Problem(eqx.Module):
    """An initial value problem on a manifold, with its solution.

    Built by the functions of `manifold_jax.problems`, not by hand. All callables
    inside are functions of a module: they are compared when compiled code is looked up, so that
    two builds of the same problem share it.

    **Attributes:**

    - `name`: the name on the command line, e.g. `"rigid-body"`.
    - `terms`: the vector field, a `diffrax.ODETerm`; by default that of the `system`.
    - `constraint`: the manifold; that of the `system` or of the `invariants`, if there are any.
    - `system`: the [`MechanicalSystem`][] both belong to, or `None` if it is none.
    - `chart`: coordinates made for this manifold, for [`LocalCoordinates`][], or `None`.
    - `y0`: the initial state at `t0`, on the manifold; by default `initial_state(args, start)`.
    - `t0`, `t1`: the time span.
    - `args`: named tuple of the physical parameters, or `None` if there are none. Pass
        it as `args` to `diffeqsolve`.
    - `start`: what the initial state is made from: one given by the user, a standard one, or
        `None` for the standard one of `args`.
    - `initial_state`: `(args, start) -> y0`, by default `start` itself.
    - `invariants`: `(t, y, args)`, conserved quantities. Frozen at `y0` they are the constraint.
    - `resets`: the jumps of its state, for [`diffeqsolve`][]; most problems have none.
    - `exact`: `(t, args, y0) -> y` in NumPy, `t` of shape `(times,)`; the leaves of
        `y` get that leading axis. Raises `ValueError` where it does not hold.
    - `reference_at_end_only`: whether `reference` knows the solution at `t1` alone.
    """

    name: str = eqx.field(static=True)
    terms: diffrax.AbstractTerm = None  # pyright: ignore[reportAssignmentType]
    _: dataclasses.KW_ONLY
    constraint: AbstractConstraint = None  # pyright: ignore[reportAssignmentType]
    system: MechanicalSystem | None = None
    chart: AbstractChart | None = None
    y0: Y = None
    t0: float = 0.0
    t1: float
    args: Args = None
    start: Y | None = None
    initial_state: Callable[[Any, Any], Y] | None = eqx.field(static=True, default=None)
    invariants: ResidualFunction | None = eqx.field(static=True, default=None)
    resets: tuple[Reset | ResetAt, ...] = ()
    exact: Callable[[np.ndarray, Any, Any], Any] = eqx.field(static=True)
    reference_at_end_only: bool = eqx.field(static=True, default=False)

    def __post_init__(self):
        self.args, self.start = jtu.tree_map(as_floating, (self.args, self.start))
        if self.y0 is None:
            rule = self.initial_state
            self.y0 = self.start if rule is None else rule(self.args, self.start)
        if self.system is not None:
            self.terms = self.system.terms if self.terms is None else self.terms
            self.constraint = self.system.constraint
        elif self.invariants is not None:
            self.constraint = Invariants(self.invariants, y0=self.y0, args=self.args)

    def with_args(self, args: Args) -> "Problem":
        """The same problem with other parameters.

        What depends on them is rebuilt, the initial state and the constraint, so that
        derivatives with respect to `args` of anything computed from the result are complete.

        ```python
        def end_position(gravity):
            problem = pendulum()
            problem = problem.with_args(problem.args._replace(gravity=gravity))
            ...
        jax.grad(end_position)(9.81)
        ```

        An initial state of the user's is kept, unless the docstring of the problem says
        how it moves with the parameters.
        """
        return dataclasses.replace(self, args=args, y0=None)

    def with_initial(self, y0: Y) -> "Problem":
        """The same problem from the initial state `y0` at `t0`.

        The state is used as it is; values of conserved quantities are frozen there.
        """
        y0 = jtu.tree_map(as_floating, y0)
        return dataclasses.replace(self, start=y0, y0=y0)

    def reference(self, t: Any) -> Any:
        """Return the solution from `y0`: exact, or published where no formula is known.

        **Arguments:**

        - `t`: one time, or times of shape `(times,)`. Where `reference_at_end_only`, `t1` alone.

        **Returns:**

        The layout of `y0` in NumPy float64, with a leading axis of length `times` if `t` has one.
        Raises `ValueError` for times, parameters or initial states at which the solution is not known.
        Formulas hold for a `y0` on the manifold.
        """
        t = np.asarray(t, np.float64)
        if t.ndim > 1:
            raise ValueError(f"`t` must be a scalar or of shape (times,), got shape {t.shape}.")
        if self.reference_at_end_only and np.any(t != self.t1):
            raise ValueError(
                f"The solution of `{self.name}` is known at the end of its time span only: "
                f"call `reference({self.t1})`, i.e. `problem.reference(problem.t1)`."
            )
        args, y0 = jtu.tree_map(lambda leaf: np.asarray(leaf, np.float64), (self.args, self.y0))
        y = self.exact(np.atleast_1d(t), args, y0)
        return y if t.ndim == 1 else jtu.tree_map(lambda leaf: leaf[0], y)


def require_standard(name: str, standard: Any, actual: Any) -> None:
    """Refuse parameters and initial states other than those of a published value.

    Compared to 1e-6, so that a problem built in single precision passes.
    """
    for a, b in zip(jtu.tree_leaves(standard), jtu.tree_leaves(actual), strict=True):
        if not np.allclose(a, b, rtol=1e-6, atol=1e-6):
            raise ValueError(
                f"The solution of `{name}` is published for its standard parameters and initial "
                "state only. Compute a reference with a tight tolerance for others."
            )


def as_floating(leaf: Any) -> Any:
    """Return a floating-point array, so that another value does not mean another compilation."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf
    return jnp.asarray(leaf, float)


def repeated(value: Any, number: int, what: str, each: str = "") -> Array:
    """Return a parameter of each of `number` things, given as an array or as one number for all."""
    value = as_floating(value)
    if value.shape not in ((), (number,)):
        raise ValueError(
            f"`{what}` must be a scalar or of shape ({number},){each}, got {value.shape}."
        )
    return jnp.broadcast_to(value, (number,))
