"""The cases of `devices_agree`: solves of a relative change of all their parameters."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

import manifold_jax as mj
from manifold_jax import problems


SAVED = 11
TIGHT = dfx.PIDController(rtol=1e-8, atol=1e-8)


class Outcome(NamedTuple):
    """Of one trajectory."""

    values: Any
    violation: Any  # the largest, at all saved values
    steps: Any


class Case(NamedTuple):
    """`solve(change, adjoint)` returns an [`Outcome`][]. `tolerance`: of differences between devices, times
    the largest value or derivative. Solvers with adaptive steps amplify rounding errors."""

    solve: Callable[[Any, dfx.AbstractAdjoint], Outcome]
    tolerance: float = 1e-9
    of_all: bool = False  # `change` are those of all trajectories
    # Whether steps have errors: where they are zero, their size, which Diffrax's adjoint
    # differentiates, has no derivative.
    has_errors: bool = True


def solved(
    terms: Any,
    solver: Any,
    constraint: Any,
    t1: float,
    y0: Any,
    args: Any,
    adjoint: dfx.AbstractAdjoint,
    controller: Any = TIGHT,
    dt0: float | None = None,
    resets: Any = (),
) -> Outcome:
    ts = jnp.linspace(0.0, t1, SAVED)
    sol = mj.diffeqsolve(
        terms,
        solver,
        0.0,
        t1,
        dt0,
        y0,
        args,
        saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller,
        adjoint=adjoint,
        resets=resets,
    )
    violation = jnp.zeros(())
    if constraint is not None:
        violation = jnp.max(mj.constraint_violation(constraint, sol.ts, sol.ys, args))
    times = () if isinstance(resets, tuple) and not resets else sol.resets.times[:2]
    return Outcome((sol.ys, times), violation, sol.stats["num_steps"])


def of_gallery(
    build: Callable,
    hook: Callable,
    t1: float,
    tolerance: float = 1e-9,
    has_errors: bool = True,
    **options: Any,
) -> Case:
    """The solve of a problem of the gallery. `hook`: makes the solver of the problem."""
    standard = build()

    def solve(change: Any, adjoint: dfx.AbstractAdjoint) -> Outcome:
        args = jtu.tree_map(lambda x: x * (1 + change), standard.args)
        problem = standard.with_args(args)
        resets = {"resets": problem.resets} if problem.resets else {}
        given = problem.constraint, t1, problem.y0, problem.args
        return solved(problem.terms, hook(problem), *given, adjoint, **resets, **options)

    return Case(solve, tolerance, has_errors=has_errors)


def projected(problem: problems.Problem) -> Any:
    return mj.Projected(dfx.Tsit5(), problem.constraint)


def in_tangent_spaces(problem: problems.Problem) -> Any:
    return mj.LocalCoordinates(dfx.Tsit5(), problem.constraint)


def in_its_chart(problem: problems.Problem) -> Any:
    return mj.LocalCoordinates(dfx.Tsit5(), problem.constraint, chart=mj.LieGroupChart(mj.SO3()))


def symmetric(problem: problems.Problem) -> Any:
    return mj.SymmetricProjection(problem.constraint)


def robertson(solver: dfx.AbstractSolver, tolerance: float = 1e-9) -> Case:
    def reaction(t, y, rates):
        slow, fast, back = rates[0] * y[0], rates[1] * y[1] ** 2, rates[2] * y[1] * y[2]
        return jnp.stack([back - slow, slow - back - fast, jnp.sum(y) - 1])

    def solve(change: Any, adjoint: dfx.AbstractAdjoint) -> Outcome:
        rates = jnp.array([0.04, 3e7, 1e4]) * (1 + change)
        terms = mj.MassMatrixTerm(reaction, jnp.array([1.0, 1.0, 0.0]))
        control = dfx.PIDController(rtol=1e-8, atol=1e-12)
        y0 = jnp.array([1.0, 0.0, 0.0])
        return solved(terms, solver, None, 100.0, y0, rates, adjoint, control)

    return Case(solve, tolerance)


def diffusion(cells: int, structure: str) -> Case:
    """A stiff system whose matrices are tridiagonal."""

    def field(t, y, rate):
        longer = jnp.concatenate([jnp.ones(1), y, jnp.zeros(1)])
        return rate * cells**2 * (longer[2:] - 2 * y + longer[:-2]) + y * (1 - y)

    def solve(change: Any, adjoint: dfx.AbstractAdjoint) -> Outcome:
        solver: Any = mj.Rodas5P(structure=structure)  # pyright: ignore[reportArgumentType]
        y0, rate = jnp.zeros(cells), 0.1 * (1 + change)
        control = dfx.PIDController(rtol=1e-6, atol=1e-8)
        return solved(dfx.ODETerm(field), solver, None, 1.0, y0, rate, adjoint, control)

    return Case(solve, 1e-8)


def trolley(t, x, xdot, gravity):
    rod = x["mass"] - jnp.stack([x["position"], jnp.zeros(())])
    pull = x["tension"] * rod
    return {
        "rates": (xdot["position"] - x["speed"], xdot["mass"] - x["velocity"]),
        "trolley": 3 * xdot["speed"] - pull[0] - x["drive"],
        "weight": xdot["velocity"] + pull + jnp.stack([jnp.zeros_like(gravity), gravity]),
        "path": x["position"] - jnp.sin(t),
        "length": rod @ rod - 1,
    }


def reduced() -> Case:
    """Equations of index 3."""
    names = ("position", "speed", "tension", "drive")
    guess = dict.fromkeys(names, 0.0) | {"mass": np.array([0.3, -0.9]), "velocity": np.zeros(2)}
    dae = mj.reduce_dae(trolley, guess, 9.81)

    def solve(change: Any, adjoint: dfx.AbstractAdjoint) -> Outcome:
        gravity = 9.81 * (1 + change)
        z0, _ = dae.consistent_state(0.0, guess, gravity)
        hook = mj.Projected(dfx.Tsit5(), dae.constraint)
        return solved(dae.terms, hook, dae.constraint, 1.0, z0, gravity, adjoint)

    return Case(solve)


def ensemble() -> Case:
    """Double pendulums in lanes."""
    problem = problems.double_pendulum()
    constraint, ts = problem.constraint, jnp.linspace(0.0, 1.0, SAVED)

    def solve(changes: Any, adjoint: dfx.AbstractAdjoint) -> Outcome:
        args = jax.vmap(lambda c: jtu.tree_map(lambda x: x * (1 + c), problem.args))(changes)
        y0s = jax.vmap(lambda args: problem.with_args(args).y0)(args)
        sol = mj.solve_ensemble(
            problem.terms,
            mj.Projected(dfx.Tsit5(), constraint),
            0.0,
            1.0,
            None,
            y0s,
            args,
            args_axes=0,
            saveat=dfx.SaveAt(ts=ts),
            stepsize_controller=TIGHT,
            lanes=32,
            adjoint=adjoint,
        )
        violation = jax.vmap(lambda *at: jnp.max(mj.constraint_violation(constraint, *at)))
        found = violation(sol.ts, sol.ys, args)
        return Outcome(sol.ys, found, sol.stats["num_steps"])

    return Case(solve, of_all=True)


def in_step(problem: problems.Problem) -> Any:
    return mj.rattle(problem.system)  # pyright: ignore[reportArgumentType]


CONSTANT = {"controller": dfx.ConstantStepSize(), "dt0": 0.01}

CASES: dict[str, Callable[[], Case]] = {
    "pendulum": lambda: of_gallery(problems.pendulum, projected, 1.0),
    "pendulum, tangent spaces": lambda: of_gallery(problems.pendulum, in_tangent_spaces, 1.0),
    "pendulum, RATTLE": lambda: of_gallery(problems.pendulum, in_step, 1.0, **CONSTANT),
    "pendulum, symmetric": lambda: of_gallery(problems.pendulum, symmetric, 1.0, **CONSTANT),
    "slider-crank": lambda: of_gallery(problems.slider_crank, projected, 2.0),
    "four-bar linkage": lambda: of_gallery(problems.four_bar, projected, 0.5),
    "rotation, SO(3)": lambda: of_gallery(problems.rotation, in_its_chart, 2.0, has_errors=False),
    "parallelogram, redundant": lambda: of_gallery(problems.parallelogram, projected, 1.0),
    "delta robot": lambda: of_gallery(problems.delta_robot, projected, 0.2),
    "polymer, 20 bonds": lambda: of_gallery(problems.polymer, projected, 0.05, 1e-8),
    "cable net": lambda: of_gallery(problems.cable_net, projected, 0.1),
    "20 four-bar linkages": lambda: of_gallery(
        lambda: problems.n_four_bar(20), projected, 0.2, 1e-8
    ),
    "Newton's cradle, impacts": lambda: of_gallery(problems.newtons_cradle, projected, 1.2),
    "Robertson, Rodas5P": lambda: robertson(mj.Rodas5P()),
    "Robertson, Radau IIA": lambda: robertson(mj.RadauIIA5(), 1e-7),
    "diffusion, dense": lambda: diffusion(20, "dense"),
    "diffusion, tridiagonal": lambda: diffusion(80, "sparse"),
    "reduced DAE": reduced,
    "ensemble": ensemble,
}
