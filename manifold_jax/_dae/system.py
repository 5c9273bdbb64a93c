"""The reduced system that users get: a vector field on a manifold."""

import math
from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.numbers import numbers_as_arrays
from .._base.shapes import are_alike, shapes
from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import check_function
from .._constraint.projection_info import ProjectionInfo
from .._rosenbrock import MassMatrixTerm
from .guess import Guess
from .initial import consistent_state
from .reduced import Reduced, ReducedConstraint
from .report import DAEReport


class ReducedDAE(eqx.Module):
    """A reduced differential-algebraic equation, made by [`reduce_dae`][]. The state `z` is a vector of
    shape `(states,)`; the names of its numbers are `report.states`."""

    system: Reduced
    report: DAEReport = eqx.field(static=True)

    def __repr__(self) -> str:
        summary, *_ = str(self.report).splitlines()
        return f"ReducedDAE({summary}; see `report`)"

    @property
    def terms(self) -> dfx.ODETerm | MassMatrixTerm:
        """The vector field on the state, a Diffrax term; NaN where the equations do not determine it.
        With `form="index-1"` a [`MassMatrixTerm`][] for [`Rodas5P`][], [`Rodas3P`][] and [`RadauIIA5`][]."""
        analysis = self.system.analysis
        if not analysis.implicit:
            return dfx.ODETerm(self.system.field)
        numbers = [analysis.layout.num_states, len(analysis.c)]
        mass = np.repeat([1.0, 0.0], numbers)
        return MassMatrixTerm(self.system.field, mass, controlled=analysis.controlled)

    @property
    def constraint(self) -> ReducedConstraint:
        """The manifold, for [`Projected`][], [`Stabilized`][] and [`LocalCoordinates`][]: the
        constraints that the equations and their derivatives impose on the state. Without any
        (`num_constraints` of the report is 0) `mj.diffeqsolve` uses the solver alone."""
        return ReducedConstraint(system=self.system)

    def consistent_state(
        self,
        t0: RealScalarLike,
        x_guess: Y,
        args: Args = None,
        *,
        derivatives: tuple[Y, ...] = (),
        fixed: Any = (),
        throw: bool = True,
    ) -> tuple[Float[Array, " states"], ProjectionInfo]:
        r"""A state near a guess that satisfies the equations and all that follows from them.

        **Arguments:**

        - `t0`: the time.
        - `x_guess`: like `x_example`. Of unknowns that are not states (multipliers) the guess does
            not matter.
        - `args`: the parameters.
        - `derivatives`: guesses for `x', x'', ...`, each like `x_guess`, for states that are derivatives
            without a name of their own; zero if not given, where equations like `x'^2 = x` do not
            determine the next derivative.
        - `fixed`: names of fixed unknowns, of whole arrays (`"q"`, of an array alone `"x"`) or
            numbers (`"q[0]"`), with `'` for derivatives, as in `report.states`. Equations for fixed
            unknowns alone have to hold for what is given.
        - `throw`: raise if there is no such state. With `throw=False` look at `info.success`.

        **Returns:**

        `(z, info)`: the state, the nearest one of the manifold in the unknowns that are not fixed (the root of
        `z - z_guess + W^-1 G^T lambda = 0`, `g(t0, z) = 0` with `G` at `z` itself), then unknowns that became states
        as equations are nonlinear in them, from those; and a [`ProjectionInfo`][]. The derivative
        with respect to all arguments is exact, however far the guess is.

        **Raises:**

        `ValueError` for names that are not states, a guess unlike `x_example`, and a
        `RuntimeError` if no state near satisfies the equations, if they cannot be satisfied
        with the fixed unknowns, or if they do not determine the derivatives at the state found
        (redundant equations, singular configurations; outside of `jit` it says which).
        """
        guess = Guess.of(self.system, x_guess, derivatives, fixed)
        return consistent_state(self.system, t0, guess, args, throw)

    def outputs(self, t: Any, z: Float[Array, "*axes states"], args: Args = None) -> Any:
        """Return all unknowns and their derivatives, `(x, x', ...)`, as many as `F` takes, multipliers
        and other algebraic unknowns included: on the manifold `F(t, *outputs, args) = 0`.

        ```python
        x, xdot = dae.outputs(sol.ts, sol.ys, args)  # x["tension"] has a leading axis for the times
        ```

        **Arguments:**

        - `t`, `z`: a time and a state, or times and states of a solution with the same leading axes.
        - `args`: the parameters, common to all.

        Derivatives that are not in the equations are found by differentiating along the solution.
        """
        return _outputs(self.system, t, z, args)

    def jump(
        self, change: Callable[..., Any], *, fixed: tuple[str, ...] = ()
    ) -> Callable[[RealScalarLike, Array, Args], Array]:
        """Return a jump of the state for [`Reset`][] and [`ResetAt`][], written in the unknowns.

        ```python
        stop = mj.Reset(
            lambda t, z, args: dae.outputs(t, z, args)[0]["q"][0] - 0.3,
            dae.jump(lambda t, x, args: {**x, "v": -args["e"] * x["v"]}, fixed=("q",)),
            direction=True,
        )
        ```

        **Arguments:**

        - `change`: `change(t, x, args) -> x`, the unknowns after the jump. For equations of order 2 or 3 it
            takes and returns derivatives, too: `change(t, x, x', args) -> (x, x')`, up to one below the
            order.
        - `fixed`: names of unknowns of the state that are exactly what `change` returns, as in
            `consistent_state`: what is stored (charges, temperatures), or positions in an impact. The others
            become those nearest to what it returns that satisfy the equations; multipliers and other algebraic
            unknowns follow from the state after the jump.

        **Returns:**

        `jump(t, z, args) -> z`. The state is not finite, which ends the solve with a result code, if none
        near satisfies the equations.

        **Raises:**

        `TypeError` if `change` cannot be called like this. When it is traced, the errors of `consistent_state`,
        and a `ValueError` if `change` does not return as many values.
        """
        order = self.system.equations.order
        given = ", ".join(["x", "xdot", "xddot"][:order])
        check_function("change", change, f"change(t, {given}, args)")

        def jump(t: RealScalarLike, z: Array, args: Args = None) -> Array:
            before = self.outputs(t, z, args)
            after = change(t, *before[:order], args)
            after = (after,) if order == 1 else after
            if not are_alike(after, before[:order]):
                raise ValueError(
                    f"`change` must return ({given}), of the structure and shapes {shapes(before[:order])}, got "
                    f"{shapes(after)}."
                )
            x, *derivatives = *after, *before[order:]
            z, info = self.consistent_state(
                t, x, args, derivatives=tuple(derivatives), fixed=fixed, throw=False
            )
            return jnp.where(info.success, z, jnp.nan)

        return jump


@numbers_as_arrays("args", times=("t",))
@eqx.filter_jit
def _outputs(system: Reduced, t: Any, z: Array, args: Args) -> tuple[Any, ...]:
    """Compiled also when called alone: operation by operation it takes ten times as long."""

    def at(t: Any, z: Array) -> tuple[Any, ...]:
        found = system.unknowns_with_derivatives(t, z, args, system.equations.order)
        return tuple(system.equations.unravel(x) for x in found)

    axes = jnp.shape(z)[:-1]
    if axes == ():
        return at(t, z)
    number = math.prod(axes)  # of a system without states, too
    several = jax.vmap(at)(jnp.broadcast_to(t, axes).reshape(-1), z.reshape(number, z.shape[-1]))
    return jax.tree_util.tree_map(lambda x: x.reshape(*axes, *x.shape[1:]), several)
