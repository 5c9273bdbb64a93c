"""What every member of the gallery is: a vector field on a manifold with a known solution."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import scipy.integrate

from .._base.types import Args, Y
from .._constraint.constraint import AbstractConstraint
from .._mechanics import MechanicalSystem
from .._solver.chart import AbstractChart


def integrate(
    field: Callable[[float, np.ndarray], Sequence[float] | np.ndarray],
    x0: Sequence[float] | np.ndarray,
    t: np.ndarray,
) -> np.ndarray:
    """`x' = field(t, x)` from `x0` at time 0: states of shape `(times, n)` at the times `t`.

    By SciPy's DOP853, as accurate as it can be: for the pendulum (10 s, 5 swings) the error
    of angle and rate is below 2e-13.
    """
    x0 = np.asarray(x0, np.float64)
    states = np.tile(x0, (t.size, 1))
    for side in (t > 0, t < 0):
        if not np.any(side):
            continue
        end = t[side][np.argmax(np.abs(t[side]))]
        solution = scipy.integrate.solve_ivp(
            field, (0.0, end), x0, method="DOP853", rtol=3e-14, atol=1e-15, dense_output=True
        )
        if not solution.success:
            raise ValueError(f"The reference solution does not reach t = {end}: {solution.message}")
        states[side] = solution.sol(t[side]).T
    return states


class Problem(eqx.Module):
    """An initial value problem on a manifold, with its solution.

    Built by the functions of `manifold_jax.problems`, not by hand. All callables
    inside are functions of a module, so that two builds of the same problem share
    their compiled code.

    **Attributes:**

    - `name`: the name on the command line, e.g. `"rigid-body"`.
    - `terms`: the vector field, a `diffrax.ODETerm`.
    - `constraint`: the manifold.
    - `system`: the [`MechanicalSystem`][] both belong to, or `None` if it is none.
    - `chart`: coordinates made for this manifold, for [`LocalCoordinates`][], or `None`.
    - `y0`: the initial state at `t0`, on the manifold.
    - `t0`, `t1`: the time span.
    - `args`: named tuple of the physical parameters, or `None` if there are none. Pass
        it as `args` to `diffeqsolve`.
    - `start`: the initial state given by the user, or `None` for the standard one.
    """

    name: str = eqx.field(static=True)
    terms: diffrax.AbstractTerm
    constraint: AbstractConstraint
    system: MechanicalSystem | None
    chart: AbstractChart | None
    y0: Y
    t0: float
    t1: float
    args: Args
    start: Y | None
    _initial_state: Callable[[Any, Any], Y] = eqx.field(static=True)
    _make_constraint: Callable[[Any, Y], AbstractConstraint] | None = eqx.field(static=True)
    _exact: Callable[[np.ndarray, Any, Any], Any] = eqx.field(static=True)
    _at_end_only: bool = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        terms: diffrax.AbstractTerm | None = None,
        *,
        system: MechanicalSystem | None = None,
        chart: AbstractChart | None = None,
        t0: float = 0.0,
        t1: float,
        args: Args = None,
        start: Y | None = None,
        y0: Y | None = None,
        initial_state: Callable[[Any, Any], Y],
        make_constraint: Callable[[Any, Y], AbstractConstraint] | None = None,
        exact: Callable[[np.ndarray, Any, Any], Any],
        at_end_only: bool = False,
    ):
        """**Arguments:**

        - `name`, `terms`, `system`, `chart`, `t0`, `t1`, `args`, `start`: as above. A `system`
            provides its constraint and, unless they are given, too, its `terms`.
        - `y0`: the initial state, by default `initial_state(args, start)`.
        - `initial_state`: `(args, start) -> y0`, where `start` is `None` for the
            standard start.
        - `make_constraint`: `(args, y0) -> constraint`, where there is no `system`.
        - `exact`: `(t, args, y0) -> y` in NumPy, `t` of shape `(times,)`; the leaves of
            `y` get that leading axis. Raises `ValueError` where it does not hold.
        - `at_end_only`: whether `exact` knows `t1` alone.

        The callables must be functions of a module: they are compared when compiled
        code is looked up.
        """
        assert (system is None) == (make_constraint is not None)
        self.name = name
        self.system = system
        self.chart = chart
        self.terms = system.terms if terms is None else terms  # pyright: ignore[reportOptionalMemberAccess]
        self.t0 = t0
        self.t1 = t1
        self.args = jtu.tree_map(as_floating, args)
        self.start = jtu.tree_map(as_floating, start)
        self.y0 = initial_state(self.args, self.start) if y0 is None else y0
        if system is None:
            self.constraint = make_constraint(self.args, self.y0)  # pyright: ignore
        else:
            self.constraint = system.constraint
        self._initial_state = initial_state
        self._make_constraint = make_constraint
        self._exact = exact
        self._at_end_only = at_end_only

    @property
    def reference_at_end_only(self) -> bool:
        """Whether `reference` knows the solution at `t1` alone."""
        return self._at_end_only

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
        return self._rebuild(args=args, start=self.start, y0=None)

    def with_initial(self, y0: Y) -> "Problem":
        """The same problem from the initial state `y0` at `t0`.

        The state is used as it is; values of conserved quantities are frozen there.
        """
        y0 = jtu.tree_map(as_floating, y0)
        return self._rebuild(args=self.args, start=y0, y0=y0)

    def reference(self, t: Any) -> Any:
        """The solution from `y0`: exact, or published where no formula is known.

        **Arguments:**

        - `t`: one time, or times of shape `(times,)`. Where
            `reference_at_end_only`, `t1` alone.

        **Returns:**

        The layout of `y0` in NumPy float64, with a leading axis of length `times` if `t`
        has one. Raises `ValueError` for times, parameters or initial states at which the
        solution is not known. Formulas hold for a `y0` on the manifold.
        """
        t = np.asarray(t, np.float64)
        if t.ndim > 1:
            raise ValueError(f"`t` must be a scalar or of shape (times,), got shape {t.shape}.")
        if self._at_end_only and np.any(t != self.t1):
            raise ValueError(
                f"The solution of `{self.name}` is known at the end of its time span only: "
                f"call `reference({self.t1})`, i.e. `problem.reference(problem.t1)`."
            )
        args, y0 = jtu.tree_map(lambda leaf: np.asarray(leaf, np.float64), (self.args, self.y0))
        y = self._exact(np.atleast_1d(t), args, y0)
        return y if t.ndim == 1 else jtu.tree_map(lambda leaf: leaf[0], y)

    def _rebuild(self, *, args: Args, start: Y | None, y0: Y | None) -> "Problem":
        return Problem(
            self.name,
            self.terms,
            system=self.system,
            chart=self.chart,
            t0=self.t0,
            t1=self.t1,
            args=args,
            start=start,
            y0=y0,
            initial_state=self._initial_state,
            make_constraint=self._make_constraint,
            exact=self._exact,
            at_end_only=self._at_end_only,
        )


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
    """A floating-point array, so that another value does not mean another compilation."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf
    return jnp.asarray(leaf, float)
