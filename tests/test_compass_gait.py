"""A walker: its published limit cycle, the multipliers and the speed of that."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj
from manifold_jax.problems.compass_gait import FIXED_POINT


PROBLEM = mj.problems.compass_gait()


def walk(angles, args, t1, **options):
    problem = mj.problems.compass_gait(angles=angles)
    problem = problem.with_args(args)
    return mj.diffeqsolve(
        problem.terms,
        mj.Projected(dfx.Tsit5(), problem.constraint),
        0.0,
        t1,
        None,
        problem.y0,
        args,
        stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-11),
        resets=problem.resets,
        max_resets=3,
        **options,
    )


def test_the_published_limit_cycle():
    """Three steps from the published state return to it three times, with the foot on the ground on both
    sides of each impact, and agree with another derivation of walker and impact."""
    ts = jnp.linspace(0.0, 12.0, 7)
    sol = walk(FIXED_POINT, PROBLEM.args, 12.0, saveat=dfx.SaveAt(ts=ts))
    assert int(sol.resets.number) == 3
    q, v = sol.resets.after
    after = jnp.stack([q[:, 2], v[:, 2], q[:, 2] - q[:, 3], v[:, 2] - v[:, 3]], axis=1)
    np.testing.assert_allclose(after, np.broadcast_to(FIXED_POINT, (3, 4)), atol=1e-11)
    for y in (sol.resets.before, sol.resets.after):
        for i in range(3):
            state = jax.tree.map(lambda x, i=i: x[i], y)
            violation = mj.constraint_violation(PROBLEM.constraint, 0.0, state, PROBLEM.args)
            assert violation < 1e-15
    for ours, exact in zip(sol.ys, PROBLEM.reference(np.asarray(ts)), strict=True):
        np.testing.assert_allclose(ours, exact, atol=3e-10)


def test_other_walkers():
    """Legs with inertia, from a start that is not periodic, through one impact."""
    problem = mj.problems.compass_gait(
        hip_mass=10.0,
        leg_mass=5.0,
        leg_inertia=0.02,
        center=0.4,
        gravity=9.81,
        slope=0.05,
        angles=(0.25, -1.3, 0.5, -0.6),
    )
    angles = 0.25, -1.3, 0.5, -0.6
    sol = walk(angles, problem.args, 1.0)
    assert int(sol.resets.number) == 1
    for ours, exact in zip(sol.ys, problem.reference(1.0), strict=True):
        np.testing.assert_allclose(ours[0], exact, atol=1e-9)


@pytest.mark.slow
def test_speed_of_the_designed_gait():
    """The limit cycle is found as a fixed point of the return map, whose derivative has two multipliers
    inside the unit circle and two that are zero, for the two equations that hold after an impact. The
    speed on it changes with the length of the legs as differences do, and as the square root of the
    scale of all lengths."""

    def step(angles, args):
        sol = walk(angles, args, 4.5)
        q, v = jax.tree.map(lambda x: x[0], sol.resets.after)
        after = jnp.stack([q[2], v[2], q[2] - q[3], v[2] - v[3]])
        return after, 2 * args.leg_length * jnp.sin(jnp.abs(q[2])) / sol.resets.times[0]

    solver = optx.Newton(rtol=1e-11, atol=1e-11)

    @jax.jit
    def gait(length, scale):
        """Return the speed with its slopes, and the angles with the derivative of the map: one program."""
        args = PROBLEM.args._replace(leg_length=length, center=scale)
        move = lambda angles, args: step(angles, args)[0] - angles
        start = jnp.array(FIXED_POINT) + 1e-3

        def speed(length, scale):
            args = PROBLEM.args._replace(leg_length=length, center=scale)
            angles = optx.root_find(move, solver, start, args).value
            value = step(angles, args)[1]
            return value, (value, angles)

        slopes, (value, angles) = jax.jacfwd(lambda p: speed(*p), has_aux=True)((length, scale))
        return value, slopes, angles, jax.jacfwd(lambda x: step(x, args)[0])(angles)

    one = jnp.ones(())
    speed, (by_length, by_center), angles, jacobian = gait(one, one)
    np.testing.assert_allclose(angles, FIXED_POINT, atol=1e-10)
    sizes = np.sort(np.abs(np.linalg.eigvals(jacobian)))
    assert np.all(sizes[:2] < 1e-10)
    assert np.all((0.5 < sizes[2:]) & (sizes[2:] < 0.6))
    h = 1e-3
    at = [gait(one + k * h, one)[0] for k in (-2, -1, 1, 2)]
    quotient = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
    np.testing.assert_allclose(by_length, quotient, rtol=1e-6)
    np.testing.assert_allclose(by_length + by_center, speed / 2, rtol=1e-8)
