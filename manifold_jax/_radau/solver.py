"""The Radau IIA method of order 5 as a Diffrax solver."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from diffrax import RESULTS

from .._base.closure import convert_closure
from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._linalg.newton import root_of_step, without_derivative
from .._linalg.rows import product
from .._rosenbrock.mass_matrix_solver import AbstractMassMatrixSolver, AttemptedStep
from .._rosenbrock.solver import RosenbrockInterpolation
from .._rosenbrock.system import System, Vector
from .iteration import size_in_tolerances, solve_stages
from .stages import constant, extrapolated, StageEquations, Stages
from .tableau import A_INVERSE, DENSE, ERROR


# The longest step, in units of the one before, into which its polynomial is continued.
_FARTHEST = 8.0


class RadauState(eqx.Module):
    """Carried from step to step.

    - `first_step`: the size of the first step that was tried (the scale of time near t = 0).
    - `derivative`: `y'`, if the mass matrix depends on time or state.
    - `usable`: whether the start is consistent.
    - `increments`, `length`: the stages of the step before and its length, zero before the first one.
    """

    first_step: FloatScalar
    derivative: Vector | None
    usable: BoolScalar
    increments: Stages
    length: FloatScalar


class _StagesOfStep(NamedTuple):
    """The stages, the error estimate, and whether the equations are defined and the stages solved."""

    Z: Stages
    error: Vector
    defined: BoolScalar
    solved: BoolScalar


class RadauIIA5(AbstractMassMatrixSolver, dfx.AbstractImplicitSolver):
    r"""Radau IIA method of order 5 with three implicit stages, for stiff ODEs and, with a
    [`MassMatrixTerm`][], differential-algebraic equations of index 1. Stiffly accurate and L-stable.

    A step is a polynomial of degree three, the dense output, that satisfies the equations in three points
    of which the last is the end of the step. The stages are solved to round-off by simplified Newton
    iterations with the Jacobian at the beginning: one real and one complex factorization of the size of
    the state per step. They start from the polynomial of the step before. Where they do not converge
    the step is repeated with a smaller step size.

    Works as any solver of Diffrax: with [`mj.diffeqsolve`][] (with constant steps as well) and
    `diffrax.diffeqsolve`, forwards and backwards in time, in [`Projected`][] (also with a mass matrix),
    [`LocalCoordinates`][] and [`Stabilized`][] (without one). All adjoints work; derivatives are those
    of the solution of the stage equations, with their exact matrix of three times the size, whatever
    the iterations did.

    The order is 5 for ODEs, for `M y' = f` and for DAEs of index 1, also with a singular `M` that depends
    on time or state, where that of [`Rodas5P`][] is 3. Fast components that follow a forcing,
    $y' = \lambda (y - \varphi(t)) + \varphi'(t)$ (Prothero & Robinson), have errors of order
    $h^3 / |\lambda|$ while $h |\lambda| \gg 1$. The error estimate has order 3 and the dense output, too:
    with small tolerances errors are far below them (on the transistor amplifier 9.5 digits at 1e-8).

    Prefer it to [`Rodas5P`][] for singular mass matrices that depend on time or state, for stiff
    mechanisms, and where many digits are needed. A step takes one (long vector fields) to seven times as
    long as one of [`Rodas5P`][], which is faster where steps are equally many.

    **Arguments:**

    - `root_finder`: of which only the tolerances are used, in which the error of stages is measured (it has
        to be below a hundredth). Those of the step size controller are put in by default; constant steps
        with `diffrax.diffeqsolve` need `diffrax.VeryChord(rtol=..., atol=..., norm=...)`.
    - `root_find_max_steps`: the most iterations for the stages of a step.

    **Raises:**

    `ValueError` for terms with noise or controls. At run time `RESULTS.nonlinear_divergence` where stages
    cannot be solved at all step sizes, or with a constant one, or the initial value is not consistent
    (see [`MassMatrixTerm`][]), and `RESULTS.nonfinite` where `f` is not finite at an accepted state.

    Source: Hairer & Wanner, Solving ODEs II, IV.8 (implementation, error estimate, stopping rule) and
    VI.1 (mass matrices).
    """

    checks_start: bool = True  # false if the state has been made consistent before
    # Of the root finder only the tolerances are used, in which the error of stages is measured. Those of the
    # step size controller are put in where the names and the type are these.
    root_finder: optx.AbstractRootFinder = eqx.field(
        default_factory=dfx.with_stepsize_controller_tols(dfx.VeryChord)
    )
    root_find_max_steps: int = eqx.field(default=10, static=True)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., RosenbrockInterpolation]] = RosenbrockInterpolation

    def order(self, terms: Any) -> int:
        return 5

    def error_order(self, terms: Any) -> int:
        return 4  # that of the error estimate of one step

    def func(self, terms: Any, t0: RealScalarLike, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def init(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> RadauState:
        derivative, usable = self.derivative_at_start(
            System.of(terms, t0, t1, y0, args), y0, "dense"
        )
        x, _ = jfu.ravel_pytree(y0)
        length = jnp.abs(jnp.asarray(t1) - t0)
        none = jnp.zeros((3, x.size), x.dtype)
        return RadauState(length, derivative, usable, none, jnp.zeros_like(length))

    @eqx.filter_jit  # traced once
    def step(
        self,
        terms: Any,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: RadauState,
        made_jump: Any,
    ) -> tuple[Y, Y | None, dict[str, Any], RadauState, RESULTS]:
        system = System.of(terms, t0, t1, y0, args)
        x0, unravel = jfu.ravel_pytree(y0)
        state = without_derivative(solver_state)
        fixed = StageEquations(*without_derivative((system, x0)))
        derivative = fixed.system.refreshed(made_jump, state.derivative, fixed.x0, "dense")
        step = without_derivative(self._solve(fixed, state, derivative))
        newton_step = StageEquations(system, x0).newton_step
        Z = root_of_step(convert_closure(newton_step, step.Z), step.Z)
        error = system.counted_error(step.error)
        attempted = AttemptedStep(x0 + Z[2], error, step.defined, step.solved)
        y1, error, result = attempted.outcome(t0, t1, state, unravel)
        k1, k2 = constant(DENSE, Z) @ Z
        dense_info = dict(y0=y0, y1=y1, k=(unravel(k1), unravel(k2)))
        return y1, error, dense_info, self._after(system, state, step.Z), result

    def _solve(
        self, equations: StageEquations, state: RadauState, derivative: Vector | None
    ) -> _StagesOfStep:
        """Return the stages and the error estimate, without derivatives."""
        x0, h = equations.x0, equations.system.step
        V0 = jnp.zeros_like(x0) if derivative is None else h.astype(x0.dtype) * derivative
        newton = equations.at_start(V0)
        unravel = jfu.ravel_pytree(equations.system.y0)[1]
        size = lambda dx, z: size_in_tolerances(
            self.root_finder,
            unravel(dx),
            unravel(x0),
            unravel(x0 + z),
        )
        unit = 8 * jnp.finfo(x0.dtype).eps
        Z, solved = solve_stages(
            equations,
            newton,
            _guess(state, h),
            lambda dZ, Z: jnp.max(jax.vmap(size)(dZ, Z)),
            size(unit * x0, jnp.zeros_like(x0)),
            self.root_find_max_steps,
        )
        combination = constant(ERROR, Z) @ Z
        error = newton.filtered(newton.f0, combination)
        counted = equations.system.counted_error

        def again() -> Vector:
            """Filter the estimate once more, where it is too large because of stiff components."""
            t0 = jnp.asarray(equations.system.t0)
            f = equations.rest(t0, x0 + error, V0) + product(newton.M, V0)
            return newton.filtered(f, combination)

        error = jax.lax.cond(size(counted(error), Z[2]) < 1, lambda: error, again)
        solved &= newton.nonsingular
        Z = jnp.where(solved, Z, 0)
        return _StagesOfStep(Z, error, newton.defined, solved)

    def _after(self, system: System, state: RadauState, Z: Stages) -> RadauState:
        h = system.step
        derivative = state.derivative
        if derivative is not None:
            # A lane of a batch that has finished makes steps of length zero.
            width = jnp.where(h == 0, 1, h).astype(Z.dtype)
            derivative = constant(A_INVERSE[2], Z) @ Z / width
        return RadauState(state.first_step, derivative, state.usable, Z, jnp.abs(h))


def _guess(state: RadauState, h: FloatScalar) -> Stages:
    """Return the polynomial of the step before, continued, or zero."""
    known = (state.length > 0) & (jnp.abs(h) <= _FARTHEST * state.length)
    ratio = jnp.where(known, jnp.abs(h) / jnp.where(known, state.length, 1), 1)
    Z = state.increments
    return jnp.where(known, extrapolated(Z, ratio.astype(Z.dtype)), 0)
