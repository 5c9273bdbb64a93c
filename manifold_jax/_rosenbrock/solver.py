"""Rosenbrock methods as Diffrax solvers."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from diffrax import RESULTS
from jaxtyping import Array, Float

from .._base.types import Args, BoolScalar, FloatScalar, RealScalarLike, Y
from .._linalg.pivoted import LARGEST_WRITTEN_OUT
from .._linalg.sparse import Choice
from .mass_matrix_solver import AbstractMassMatrixSolver, AttemptedStep
from .sparsity import check_structure
from .stages import rosenbrock_step
from .system import System
from .tableau import RODAS3P, RODAS5P, RosenbrockTableau


class RosenbrockInterpolation(dfx.AbstractLocalInterpolation):
    """`(1 - s) y0 + s (y1 + (1 - s) (k_1 + s (k_2 + ...)))`, with `s` from 0 to 1 over the step."""

    t0: RealScalarLike
    t1: RealScalarLike
    y0: Y
    y1: Y
    k: tuple[Y, ...]

    def evaluate(
        self, t0: RealScalarLike, t1: RealScalarLike | None = None, left: bool = True
    ) -> Y:
        if t1 is not None:
            return jtu.tree_map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        width = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(width == 0, 1, width)

        def value(y0, y1, *k):
            x = s.astype(y0.dtype)
            bump = k[-1]
            for part in reversed(k[:-1]):
                bump = part + x * bump
            return (1 - x) * y0 + x * (y1 + (1 - x) * bump)

        return jtu.tree_map(value, self.y0, self.y1, *self.k)


class RosenbrockState(eqx.Module):
    """Carried from step to step: the size of the first step that was tried (the scale of time near t =
    0), `y'` if the mass matrix depends on the state, and whether the start is consistent."""

    first_step: FloatScalar
    derivative: Float[Array, " n"] | None
    usable: BoolScalar


class AbstractRosenbrock(AbstractMassMatrixSolver):
    """Linearly implicit one-step methods: instead of nonlinear equations each stage has a linear
    system. All have the same matrix `M / gamma - h df/dy`, which is factored once per step."""

    tableau: eqx.AbstractClassVar[RosenbrockTableau]
    structure: Choice = eqx.field(default="auto", static=True)
    checks_start: bool = True  # false if the state has been made consistent before
    # Largest number of rows for which the elimination is written out, without LAPACK.
    largest_written_out: int = eqx.field(default=LARGEST_WRITTEN_OUT, static=True)

    def __check_init__(self):
        check_structure(self.structure)

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., RosenbrockInterpolation]] = RosenbrockInterpolation

    def order(self, terms: Any) -> int:
        return self.tableau.order

    def func(self, terms: Any, t0: RealScalarLike, y0: Y, args: Args) -> Any:
        return terms.vf(t0, y0, args)

    def init(
        self, terms: Any, t0: RealScalarLike, t1: RealScalarLike, y0: Y, args: Args
    ) -> RosenbrockState:
        system = System.of(terms, t0, t1, y0, args)
        derivative, usable = self.derivative_at_start(system, y0, self.structure)
        return RosenbrockState(jnp.abs(jnp.asarray(t1) - t0), derivative, usable)

    @eqx.filter_jit  # traced once
    def step(
        self,
        terms: Any,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: RosenbrockState,
        made_jump: Any,
    ) -> tuple[Y, Y | None, dict[str, Any], RosenbrockState, RESULTS]:
        system = System.of(terms, t0, t1, y0, args)
        x0, unravel = jfu.ravel_pytree(y0)
        derivative = system.refreshed(made_jump, solver_state.derivative, x0, self.structure)
        step = rosenbrock_step(
            self.tableau, system, x0, derivative, self.structure, self.largest_written_out
        )
        error = system.counted_error(step.error)
        attempted = AttemptedStep(step.x1, error, step.defined, step.nonsingular)
        y1, error, result = attempted.outcome(t0, t1, solver_state, unravel)
        dense_info = dict(y0=y0, y1=y1, k=tuple(unravel(k) for k in step.dense))
        state = RosenbrockState(solver_state.first_step, step.derivative, solver_state.usable)
        return y1, error, dense_info, state, result


class Rodas5P(AbstractRosenbrock):
    r"""Rosenbrock method of order 5 (error estimate and dense output of order 4) with eight stages,
    for stiff ODEs and, with a [`MassMatrixTerm`][], differential-algebraic equations of
    index 1. Stiffly accurate and L-stable.

    Each step evaluates the exact Jacobian once (forward mode, also by time), factors one matrix
    $M/\gamma - h\, \partial f/\partial y$ and solves with it once per stage: nothing is
    iterated. Small systems are solved by written-out arithmetic, without LAPACK; large sparse ones
    (discretized partial differential equations, circuits, networks) at a cost that grows with the
    number of unknowns, see `structure`.

    **Arguments:**

    - `structure`: how the linear systems of a step are solved. Which equation depends on which unknown
        is found from the traced vector field, the Jacobian has one column for all unknowns of a
        color, and unknowns that no equation couples are eliminated at the same time, without exchanges
        of rows (a tridiagonal matrix by LAPACK). Where that takes too long, or is not accurate because
        of algebraic equations, KLU does it if klujax is installed (the extra `sparse`; CPUs and 64-bit
        numbers). `"auto"` does so from 64 unknowns on (KLU: 128) where the structure allows, `"dense"`
        never, `"sparse"` always, with an error where it cannot. Masses that are matrices are sparse only
        on request, and with rows of zeros for the algebraic equations. Sparse matrices and indices
        in `f` should be NumPy arrays that the function closes over: in `args` they are not known.

    Works as any solver of Diffrax: with `diffrax.diffeqsolve` and [`mj.diffeqsolve`][],
    forwards and backwards in time, in [`Projected`][] (also with a mass matrix),
    [`LocalCoordinates`][] and [`Stabilized`][] (without one). All adjoints work; derivatives
    are those of the steps, second derivatives of `f` included.

    The order is 5 for non-autonomous equations, for `M y' = f` with constant or nonsingular
    `M(t, y)` and for DAEs of index 1 with constant `M`; with a singular `M` that depends on time or
    state it is 3. Fast components that follow a forcing, $y' = \lambda (y - \varphi(t)) +
    \varphi'(t)$ (Prothero & Robinson), have errors of order $h^3 / |\lambda|$ while
    $h |\lambda| \gg 1$, where the stage order shows, and $h^5$ below.

    Every sparse factorization is checked by a system with a known solution; a step in which the
    check fails is repeated with a smaller one, and ends with `RESULTS.nonlinear_divergence` where
    that does not help: then use `structure="dense"`.

    Prefer [`Rodas3P`][] for tolerances of 1e-3 and above, `diffrax.Kvaerno5()` where the Jacobian is
    far more expensive than the vector field, `diffrax.Tsit5()` where nothing is stiff.

    **Raises:**

    `ValueError` for terms with noise or controls, and for `structure="sparse"` where most equations
    depend on most unknowns, where they are structurally singular, or where a library is needed that is
    not installed. At run time `RESULTS.nonlinear_divergence`
    where the matrix is singular at all step sizes, or the initial value is not consistent (see
    [`MassMatrixTerm`][]), and `RESULTS.nonfinite` where `f` is not finite at an accepted state.

    Source: Steinebach, BIT Numer. Math. 63:27 (2023); coefficients as published there, dense output
    included. Hairer & Wanner, Solving ODEs II, IV.7 and VI.4 (methods and their implementation); Curtis,
    Powell & Reid, J. Inst. Maths Applics 13 (1974) 117-119 (colors).
    """

    tableau: ClassVar[RosenbrockTableau] = RODAS5P


class Rodas3P(AbstractRosenbrock):
    r"""Rosenbrock method of order 3 (error estimate of order 2, dense output 3) with five stages and
    three evaluations of the vector field, for loose tolerances; all else as [`Rodas5P`][].

    The order is 3 where that of [`Rodas5P`][] is 5; with a singular `M` that depends on time or
    state it is 2. Fast components that follow a forcing have errors of order $h^2 / |\lambda|$.

    Source: Steinebach, Rosenbrock methods within OrdinaryDiffEq.jl - Overview, recent developments
    and applications, Proc. JuliaCon Conf. (2024).
    """

    tableau: ClassVar[RosenbrockTableau] = RODAS3P
