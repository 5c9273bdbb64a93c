"""The gallery's large mechanisms at a hundred bodies and more: on the manifold, with their energy, at every
step; gradients as differences."""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj
from manifold_jax.problems.polymer import energy


pytestmark = pytest.mark.slow
STEPS = 20


class Case(NamedTuple):
    problem: mj.problems.Problem
    parameter: str
    height: int | None  # which coordinate weighs


CASES = {
    "polymer": lambda: Case(mj.problems.polymer(100, t1=0.2), "stiffness", None),
    "cable-net": lambda: Case(mj.problems.cable_net(5, 20, t1=0.2), "gravity", 2),
    "falling-truss": lambda: Case(mj.problems.falling_truss(50, t1=1.0), "gravity", 1),
    "n-four-bar": lambda: Case(mj.problems.n_four_bar(50, t1=0.4), "gravity", 1),
}


def energies(case, y):
    """Of each row."""
    problem, (q, v) = case.problem, y
    if case.height is None:
        return np.array([energy(row, problem.args) for row in zip(q, v)])
    masses = np.asarray(problem.system.mass_matrix.function(jnp.asarray(q[0]), problem.args))
    weight = float(problem.args.mass * problem.args.gravity)
    every = lambda x: np.asarray(x).reshape(len(q), -1).sum(axis=1)
    return every(0.5 * masses * v**2) + weight * every(q[..., case.height])


@pytest.mark.parametrize("build", CASES.values(), ids=CASES)
def test_every_step_and_a_gradient(build):
    case = build()
    problem, name = case.problem, case.parameter

    def end(value):
        args = problem.args._replace(**{name: value})
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Tsit5(), problem.constraint),
            0.0,
            problem.t1,
            problem.t1 / STEPS,
            problem.y0,
            args,
            saveat=dfx.SaveAt(steps=True),
            max_steps=STEPS,
        )
        return jnp.sum(jnp.sin(sol.ys[0][-1])), sol

    program = jax.jit(jax.value_and_grad(end, has_aux=True))
    value = jnp.asarray(getattr(problem.args, name), float)
    (_, sol), slope = program(value)
    violation = mj.constraint_violation(problem.constraint, sol.ts, sol.ys, problem.args)
    assert jnp.max(violation) < 1e-15
    every = energies(case, jax.tree.map(np.asarray, sol.ys))
    assert np.ptp(every) < 1e-8 * max(1.0, abs(every[0]))
    h = 1e-3 * float(value)
    near, far = (program(value + k * h)[0][0] - program(value - k * h)[0][0] for k in (1, 2))
    np.testing.assert_allclose(slope, (8 * near - far) / (12 * h), rtol=1e-7)
