"""Convergence orders of projected solvers, two-sided, on asymmetric problems.

Not on the uniform circle, nor with every invariant enforced: symmetry and the removal of
the leading error term raise the order there.
"""

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj


# The implicit stages are solved to round-off, so that their error does not show.
NEWTON = dict(root_finder=optx.Newton(rtol=1e-13, atol=1e-14))
# Solver, expected order, and step counts whose errors lie in the range of the fit.
METHODS = {
    "Euler": (dfx.Euler(), 1, [16384, 32768, 65536, 131072]),
    "Heun": (dfx.Heun(), 2, [256, 512, 1024, 2048, 4096]),
    "Bosh3": (dfx.Bosh3(), 3, [128, 256, 512, 1024, 2048]),
    "Dopri5": (dfx.Dopri5(), 5, [128, 192, 256, 384, 512]),
    # Its fourth-order error terms are small: the order shows at fine steps only.
    "Tsit5": (dfx.Tsit5(), 5, [192, 256, 320, 384]),
    "Kvaerno3": (dfx.Kvaerno3(**NEWTON), 3, [128, 256, 512, 1024, 2048]),
    "Kvaerno5": (dfx.Kvaerno5(**NEWTON), 5, [128, 192, 256, 384, 512]),
    "Dopri8": (dfx.Dopri8(), 8, [12, 14, 16, 20, 24, 28, 32, 40]),
}


def sphere_only():
    """The rigid body with |y|^2 = 1 as its only constraint."""
    problem = mj.problems.rigid_body()
    end = 20.0
    constraint = mj.Constraint(lambda t, y, args: y @ y - 1.0)
    return problem, constraint, end


def pendulum():
    problem = mj.problems.pendulum(q0=(0.8, -0.6), v0=(0.3, 0.4))
    return problem, problem.constraint, 3.0


def double_pendulum():
    problem = mj.problems.double_pendulum()
    return problem, problem.constraint, 1.5


def fitted_order(solver, counts, problem, constraint, end, hook=mj.Projected):
    """Least-squares slope of log(error) against log(step), errors in 1e-11 .. 1e-2."""
    hooked = hook(solver, constraint)

    @jax.jit
    def solve(dt0):
        sol = mj.diffeqsolve(
            problem.terms, hooked, 0.0, end, dt0, problem.y0, problem.args, max_steps=140000
        )
        return jfu.ravel_pytree(sol.ys)[0]

    exact = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(problem.reference(end))])
    errors = np.array([np.abs(np.asarray(solve(end / count)) - exact).max() for count in counts])
    fit = (errors > 1e-11) & (errors < 1e-2)
    assert fit.sum() >= 3, errors
    slope, _ = np.polyfit(np.log(1 / np.array(counts)[fit]), np.log(errors[fit]), 1)
    return slope, errors


@pytest.mark.parametrize("make", [sphere_only, pendulum])
@pytest.mark.parametrize("name", METHODS)
def test_order(name, make):
    solver, order, counts = METHODS[name]
    slope, errors = fitted_order(solver, counts, *make())
    print(f"{name:9s} {make.__name__:12s} slope {slope:.3f}  errors {errors}")
    check(name, slope, order)


def check(name, slope, order):
    if name == "Dopri8":
        assert 7.5 <= slope <= 9
    else:
        assert abs(slope - order) <= 0.2


HOOKS = {
    "projected": mj.Projected,
    "tangent": mj.LocalCoordinates,
    "partition": lambda solver, constraint: mj.LocalCoordinates(
        solver, constraint, chart=mj.CoordinatePartitionChart()
    ),
    "invariant": lambda solver, constraint: mj.Stabilized(
        solver, constraint, stabilization=mj.InvariantStabilization(2.0)
    ),
    "exact": lambda solver, constraint: mj.Stabilized(
        solver, constraint, stabilization=mj.ExactStabilization(2.0)
    ),
}
PROBLEMS = [sphere_only, pendulum, double_pendulum]
# One solver for every approach by default, the rest in the slow part.
QUICK = {("Dopri5", make, hook) for make in (double_pendulum,) for hook in HOOKS}
CASES = [
    pytest.param(
        name,
        make,
        hook,
        marks=() if (name, make, hook) in QUICK else pytest.mark.slow,
        id=f"{name}-{make.__name__}-{hook}",
    )
    for name in ("Bosh3", "Dopri5", "Dopri8")
    for make in PROBLEMS
    for hook in HOOKS
    if hook != "projected" or make is double_pendulum  # the others are above
]


@pytest.mark.parametrize(("name", "make", "hook"), CASES)
def test_order_of_every_approach(name, make, hook):
    solver, order, counts = METHODS[name]
    slope, errors = fitted_order(solver, counts, *make(), HOOKS[hook])
    print(f"{name:9s} {make.__name__:15s} {hook:10s} slope {slope:.3f}  errors {errors}")
    check(name, slope, order)
