"""Reverse mode by replaying recorded steps: the gradient of Diffrax, by another way."""

import re

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import manifold_jax as mj
from manifold_jax._solver.step import explicit


THETA = jnp.array([9.81, 1.1, 0.8])
CONTROLLER = dfx.PIDController(rtol=1e-6, atol=1e-6)
RELEASED = (jnp.array([0.8, -0.6]), jnp.array([0.3, 0.4]))


def pendulum_field(t, y, gravity):
    q, v = y
    mu = (v @ v - gravity * q[1]) / (q @ q)
    return v, -mu * q - gravity * jnp.array([0.0, 1.0])


def saved(
    theta,
    sign,
    adjoint,
    hook,
    saving,
    solver,
    t1=2.0,
    controller=CONTROLLER,
    max_steps=200,
    dt0=None,
):
    """A pendulum of gravity and length `theta[:2]`, started with the speed `theta[2]`; backwards in
    time for a `sign` of -1, and not at all for 0, all in one program."""
    gravity, length, speed = theta
    # the length is closed over, gravity an argument
    circle = mj.Constraint(lambda t, y, args: jnp.stack([y[0] @ y[0] - length**2, y[0] @ y[1]]))
    if hook is None:
        wrapped = solver
    elif hook is mj.Stabilized:
        gain = mj.InvariantStabilization(5.0)
        wrapped = mj.Stabilized(solver, circle, stabilization=gain)
    elif isinstance(hook, mj.CoordinatePartitionChart):
        wrapped = mj.LocalCoordinates(solver, circle, chart=hook)
    else:
        wrapped = hook(solver, circle)
    y0 = (length * RELEASED[0], speed * jnp.stack([RELEASED[0][1], -RELEASED[0][0]]))
    return mj.diffeqsolve(
        dfx.ODETerm(pendulum_field),
        wrapped,
        0.0,
        sign * t1,
        None if dt0 is None else jnp.where(sign < 0, -dt0, dt0),
        y0,
        gravity,
        saveat=SAVING[saving](sign * TIMES),
        adjoint=adjoint,
        stepsize_controller=controller,
        max_steps=max_steps,
    )


def loss(theta, sign, adjoint, *rest, **options):
    """And statistics of the solve."""
    sol = saved(theta, sign, adjoint, *rest, **options)
    total = 0.0
    for i, y in enumerate(jax.tree.leaves(sol.ys)):
        used = jnp.isfinite(y)
        weights = jnp.cos(jnp.arange(y.size) + i).reshape(y.shape)
        total += jnp.sum(weights * jnp.where(used, jnp.where(used, y, 0.0) ** 2, 0.0))
    return total, sol.stats


def reverse_mode(*case, replay=None, **options):
    """The gradient as a function of parameters and direction of time, and the statistics."""
    replay = mj.StepReplayAdjoint() if replay is None else replay
    return jax.grad(lambda theta, sign: loss(theta, sign, replay, *case, **options), has_aux=True)


def forward_mode(*case, **options):
    forward = dfx.ForwardMode()
    return jax.jacfwd(
        lambda theta, sign: loss(theta, sign, forward, *case, **options), has_aux=True
    )


def check(*case, signs=(1.0,), replay=None, **options):
    reverse = jax.jit(reverse_mode(*case, replay=replay, **options))
    forward = jax.jit(forward_mode(*case, **options))
    for sign in signs:
        agree(reverse(THETA, sign)[0], forward(THETA, sign)[0])


def agree(reverse, forward):
    np.testing.assert_allclose(reverse, forward, rtol=1e-11, atol=1e-12 * np.abs(forward).max())
    assert np.abs(forward).min() > 1e-3


TIMES = jnp.linspace(0.0, 1.9, 77)
SAVING = {
    "t1": lambda ts: dfx.SaveAt(t1=True),
    "t0, ts, t1": lambda ts: dfx.SaveAt(t0=True, ts=ts, t1=True),
    "t0 and ts, t1": lambda ts: dfx.SaveAt(
        subs=[dfx.SubSaveAt(t0=True, ts=ts), dfx.SubSaveAt(t1=True)]
    ),
    "steps": lambda ts: dfx.SaveAt(steps=True),
    "t0, every third step, ts, t1": lambda ts: dfx.SaveAt(t0=True, steps=3, ts=ts, t1=True),
    "subs with functions": lambda ts: dfx.SaveAt(
        subs=[
            dfx.SubSaveAt(ts=ts, fn=lambda t, y, args: t * args + y[0] @ y[0]),
            dfx.SubSaveAt(steps=True, fn=lambda t, y, args: y[1] * y[0][0] * args),
            dfx.SubSaveAt(t0=True, t1=True, fn=lambda t, y, args: (y[0], None)),
        ]
    ),
}


slow = lambda *values: pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("name", "checkpoints"),
    [
        ("subs with functions", None),
        ("t0, every third step, ts, t1", 25),
        *(slow(n, None) for n in SAVING if n != "subs with functions"),
        slow("t0, ts, t1", 7),
        slow("subs with functions", 14),
    ],
)
def test_every_way_of_saving(name, checkpoints):
    """Forwards and backwards in time."""
    check(
        mj.Projected,
        name,
        dfx.Bosh3(),
        signs=(1.0, -1.0),
        replay=mj.StepReplayAdjoint(checkpoints=checkpoints),
        controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
    )


HOOKS = {
    "plain": None,
    "stabilized": mj.Stabilized,
    "tangent space": mj.LocalCoordinates,
    "coordinate partition": mj.CoordinatePartitionChart(),
}


@pytest.mark.parametrize("hook", [slow(h) if h != "stabilized" else h for h in HOOKS])
def test_every_approach(hook):
    check(HOOKS[hook], "t0, ts, t1", dfx.Dopri5())


@pytest.mark.slow
def test_an_implicit_solver():
    """With few large steps the gradient depends on how XLA rounds in either program."""
    tight = dfx.PIDController(rtol=1e-9, atol=1e-9)
    check(mj.Projected, "t0, ts, t1", dfx.Kvaerno5(), controller=tight, max_steps=500)


def test_constant_steps_and_none_at_all():
    """With `t0 == t1` everything saved is the start: rows of `ts` before that of `t1`."""
    case = (mj.Projected, "t0, ts, t1", dfx.Heun())
    options = dict(controller=dfx.ConstantStepSize(), dt0=0.03)
    reverse = jax.jit(reverse_mode(*case, **options))
    forward = jax.jit(forward_mode(*case, **options))
    agree(reverse(THETA, 1.0)[0], forward(THETA, 1.0)[0])
    (gradient, stats), (expected, _) = reverse(THETA, 0.0), forward(THETA, 0.0)
    assert stats["num_steps"] == 0
    np.testing.assert_allclose(gradient, expected, rtol=1e-12)
    assert gradient[0] == 0  # of gravity
    assert np.abs(gradient[1:]).min() > 0.1


def test_equal_to_recursive_checkpointing_with_given_steps():
    def gradient(adjoint):
        # StepTo takes no first step
        def objective(theta):
            gravity, length, speed = theta
            problem = mj.problems.pendulum(gravity=gravity, length=length)
            sol = mj.diffeqsolve(
                problem.terms,
                mj.Projected(dfx.Bosh3(), problem.constraint),
                0.0,
                2.0,
                None,
                (problem.y0[0], problem.y0[1] + speed * jnp.array([0.0, 1.0])),
                problem.args,
                saveat=SAVING["t0, ts, t1"](TIMES),
                adjoint=adjoint,
                stepsize_controller=dfx.StepTo(ts=jnp.linspace(0.0, 2.0, 60)),
            )
            return jnp.sum(jnp.sin(sol.ys[0]) * sol.ys[1])

        return jax.jit(jax.grad(objective))(THETA)

    replayed, checkpointed = (
        gradient(mj.StepReplayAdjoint()),
        gradient(dfx.RecursiveCheckpointAdjoint()),
    )
    np.testing.assert_allclose(replayed, checkpointed, rtol=1e-12)


def test_batch_equals_single_also_with_rejected_steps():
    """Lanes with different numbers of steps; their common loop is as long as the longest. Rejected
    steps are recorded, too: the first one, where `t0` is saved, and others between."""
    case = (mj.Projected, "t0, ts, t1", dfx.Tsit5())
    controller = dfx.PIDController(rtol=1e-6, atol=1e-6, pcoeff=0, icoeff=1.6)
    options = dict(controller=controller, dt0=1.5)
    thetas = jnp.stack([THETA, THETA * jnp.array([3.0, 0.5, 2.0]), THETA * 0.3])
    reverse = reverse_mode(*case, **options)
    batch, stats = jax.jit(jax.vmap(reverse, in_axes=(0, None)))(thetas, 1.0)
    assert len(set(stats["num_steps"].tolist())) == 3
    rejected = stats["num_rejected_steps"]
    assert rejected[0] > 10
    assert rejected[0] != rejected[1]
    single = jax.jit(reverse)
    for theta, row in zip(thetas, batch):
        np.testing.assert_allclose(row, single(theta, 1.0)[0], rtol=1e-11)
    agree(single(THETA, 1.0)[0], jax.jit(forward_mode(*case, **options))(THETA, 1.0)[0])


def test_a_rejected_first_step_without_a_value():
    """The start is saved: its row lies at the end of no step, and must not pass that one's NaN."""
    total = mj.Constraint(lambda t, y, args: jnp.sum(y) - 1)

    def value(rate, adjoint):
        flow = lambda t, y, args: rate * jnp.sqrt(y[0]) * jnp.array([-1.0, 1.0])
        sol = mj.diffeqsolve(
            dfx.ODETerm(flow),
            mj.Projected(dfx.Bosh3(), total),
            0.0,
            1.0,
            1.0,  # too large: the root of what is negative
            jnp.array([1.0, 0.0]),
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 5)),
            stepsize_controller=CONTROLLER,
            max_steps=100,
            adjoint=adjoint,
        )
        return jnp.sum(sol.ys[:, 0] ** 2), sol.stats["num_rejected_steps"]

    rate = jnp.asarray(1.9)
    by_forward = jax.jacfwd(lambda r: value(r, dfx.ForwardMode()), has_aux=True)
    forward, rejected = jax.jit(by_forward)(rate)
    assert rejected > 0
    by_reverse = jax.grad(lambda r: value(r, mj.StepReplayAdjoint()), has_aux=True)
    reverse, _ = jax.jit(by_reverse)(rate)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)


def test_the_record_of_a_batch_is_written_in_slices():
    """An index of its own for each trajectory would make it a scatter."""
    gradient = reverse_mode(mj.Projected, "t1", dfx.Heun(), max_steps=208)
    batch = jnp.stack([THETA, THETA, THETA])
    program = jax.jit(jax.vmap(lambda theta: gradient(theta, 1.0)[0])).lower(batch).compile()
    program = program.as_text()
    # Trajectories, blocks, steps, columns.
    written = re.findall(r"\[3,26,8,\d\]\S* ([\w-]+)\(", program)
    assert "dynamic-update-slice" in written
    assert "scatter" not in written


def test_derivatives_of_stages_are_computed_once_in_a_batch():
    """XLA would copy the chain of all stages into the derivative of each, 5 times the products."""
    circle = mj.Constraint(lambda t, y, args: jnp.stack([y[0] @ y[0] - 1, y[0] @ y[1]]))
    solver, term = mj.Projected(dfx.Dopri8(), circle), dfx.ODETerm(pendulum_field)

    def pulled_back(y, h, gravity, bar):
        def end(y, gravity):
            state = solver.init(term, 0.0, h, y, gravity)
            return solver.step(term, 0.0, h, y, gravity, state, False)[0]

        return jax.vjp(end, y, gravity)[1](bar)

    y = jax.tree.map(lambda x: jnp.stack([x] * 64), RELEASED)
    args = y, jnp.full(64, 0.01), jnp.full(64, 9.81), y
    traced = str(jax.make_jaxpr(jax.vmap(pulled_back))(*args)).count("= mul ")
    compiled = jax.jit(jax.vmap(pulled_back)).lower(*args).compile().as_text().count(" multiply(")
    assert compiled < 3 * traced


def test_one_counter_for_the_whole_batch():
    """A counter for each trajectory would make every access to the record a gather."""
    case = (mj.Projected, "t0, ts, t1", dfx.Heun())
    value = lambda theta: loss(theta, 1.0, mj.StepReplayAdjoint(), *case)[0]
    batch = jnp.stack([THETA, THETA])
    solve, both = (
        [first_carried(loop) for loop in loops(jax.make_jaxpr(jax.vmap(f))(batch).jaxpr)]
        for f in (value, jax.grad(value))
    )
    counters = [x.shape for x in both[len(solve) :] if jnp.issubdtype(x.dtype, jnp.integer)]
    segments_blocks_steps, rows = counters[:3], counters[3:]
    assert segments_blocks_steps == [(), (), ()]
    assert rows == [(2,)]  # interpolated values of one step: each trajectory its own


def first_carried(loop):
    constants = loop.params["cond_nconsts"] + loop.params["body_nconsts"]
    return loop.invars[constants].aval


def loops(jaxpr):
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation
        for value in equation.params.values():
            if hasattr(value, "jaxpr"):
                yield from loops(value.jaxpr)


@pytest.mark.slow
@pytest.mark.parametrize("hook", [mj.Projected, None], ids=["projected", "plain"])
@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Kvaerno3()], ids=["Tsit5", "Kvaerno3"])
def test_hessian_vector_product(hook, solver):
    """Forward over the replay: the loops back are differentiable forwards."""
    case = (hook, "t1", solver)
    direction = jnp.array([0.3, -0.2, 0.5])

    def along(gradient):
        return jax.jit(lambda theta: jax.jvp(gradient, (theta,), (direction,))[1])(THETA)

    replayed = along(lambda theta: reverse_mode(*case, t1=0.5)(theta, 1.0)[0])
    forward = along(lambda theta: forward_mode(*case, t1=0.5)(theta, 1.0)[0])
    np.testing.assert_allclose(replayed, forward, rtol=1e-10)


def test_stochastic():
    """Brownian motion is a function of time, and the same in the reverse sweep. It refuses derivatives
    with respect to times, also those that are zero."""
    problem = mj.problems.sphere_flow()
    noise = dfx.VirtualBrownianTree(0.0, 1.0, 1e-3, (), jax.random.key(0))

    def end(scale, adjoint):
        diffusion = dfx.ControlTerm(
            lambda t, y, args: 0.3 * scale * (y @ y) * jnp.roll(y, 1) - y * (y @ jnp.roll(y, 1)),
            noise,
        )
        sol = mj.diffeqsolve(
            dfx.MultiTerm(problem.terms, diffusion),
            mj.Projected(dfx.Heun(), problem.constraint),
            0.0,
            1.0,
            0.05,
            problem.y0,
            problem.args,
            adjoint=adjoint,
        )
        return sol.ys[0] @ jnp.arange(1.0, 1 + problem.y0.size)

    replayed = lambda scale: end(scale, mj.StepReplayAdjoint())
    by_diffrax = lambda scale: end(scale, dfx.ForwardMode())
    forwards = jax.jit(lambda scale: [jax.jacfwd(f)(scale) for f in (by_diffrax, replayed)])
    twice = jax.jit(lambda scale: jax.jvp(jax.grad(replayed), (scale,), (1.0,)))
    expected, repeated = forwards(1.0)
    reverse, second = twice(1.0)
    np.testing.assert_allclose([reverse, repeated], expected, rtol=1e-11)
    difference = (twice(1 + 1e-4)[0] - twice(1 - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(second, difference, rtol=1e-6)


def released(theta, t0=0.0, t1=1.0, **options):
    """A pendulum of gravity `theta`, in large constant steps unless they are given."""
    problem = mj.problems.pendulum()
    return mj.diffeqsolve(
        problem.terms,
        mj.Projected(options.pop("solver", dfx.Bosh3()), problem.constraint),
        t0,
        t1,
        options.pop("dt0", 0.1),
        problem.y0,
        problem.args._replace(gravity=theta),
        **options,
    )


def test_refusals():
    with pytest.raises(ValueError, match="`checkpoints`"):
        mj.StepReplayAdjoint(checkpoints=0)
    end = lambda dt0: released(9.81, dt0=dt0).ys[0][0, 0]
    with pytest.raises(RuntimeError, match="`dt0`"):
        jax.grad(end)(0.1)
    unbounded = lambda g: released(g, max_steps=None).ys[0][0, 0]
    assert np.isfinite(unbounded(9.81))
    with pytest.raises(RuntimeError, match="`max_steps`"):
        jax.grad(unbounded)(9.81)


def test_times():
    """Of the ends and of what is saved; the steps between stay where they are."""
    fn = lambda t, y, args: (t * y[0][0], (y[0][0], y[1][0]))

    def values(times):
        t0, t, t1 = times
        saveat = dfx.SaveAt(ts=t[None], t1=True, fn=fn)
        sol = released(9.81, t0, t1, solver=dfx.Tsit5(), dt0=0.01, saveat=saveat)
        product, state = sol.ys
        return jnp.concatenate([product, sol.ts**2]), (*state, sol.ts)

    (at_ts, at_t1, ts, t1), (x, v, t) = jax.jit(jax.jacrev(values, has_aux=True))(
        jnp.array([0.2, 0.5, 1.0])
    )
    # The field does not depend on time: later starts are the same motion later.
    np.testing.assert_allclose(at_ts, [-t[0] * v[0], x[0] + t[0] * v[0], 0], atol=1e-6)
    np.testing.assert_allclose(at_t1, [-t[1] * v[1], 0, x[1] + t[1] * v[1]], atol=1e-6)
    np.testing.assert_allclose((ts, t1), [[0, 1, 0], [0, 0, 2]], atol=1e-12)


def test_dense_solution_and_solver_state():
    """Of a solve that goes on where another ended."""

    def value(gravity, adjoint):
        kept = dfx.SaveAt(t1=True, dense=True, solver_state=True)
        options = dict(adjoint=adjoint, max_steps=20)
        first = released(gravity, saveat=kept, **options)
        problem = mj.problems.pendulum()
        sol = mj.diffeqsolve(
            problem.terms,
            mj.Projected(dfx.Bosh3(), problem.constraint),
            1.0,
            1.5,
            0.1,
            jax.tree.map(lambda y: y[-1], first.ys),
            problem.args._replace(gravity=gravity),
            solver_state=first.solver_state,
            consistent="assume",
            **options,
        )
        return first.evaluate(0.43)[1] @ jnp.array([1.0, 2.0]) + sol.ys[0][0, 0]

    reverse = jax.jit(jax.grad(lambda g: value(g, mj.StepReplayAdjoint())))(9.81)
    forward = jax.jit(jax.jacfwd(lambda g: value(g, dfx.ForwardMode())))(9.81)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)


@pytest.mark.parametrize(("second", "in_a_loop"), [("end", False), ("times", True)])
@pytest.mark.usefixtures("traced_anew")
def test_a_solve_that_goes_on_from_the_state_of_a_solver(second, in_a_loop, monkeypatch):
    """If only ends are saved, steps are made again from the state alone; the vector field that the
    second solve gets is then known to depend on the same parameters."""
    if in_a_loop:
        monkeypatch.setattr(explicit, "LARGEST_UNROLLED", 0)
    problem = mj.problems.pendulum()
    solver = mj.Projected(dfx.Bosh3(), problem.constraint)

    def value(parameters):
        gravity, start = parameters
        args = problem.args._replace(gravity=gravity)
        controller = dfx.PIDController(rtol=1e-5, atol=1e-5)
        options = dict(args=args, stepsize_controller=controller, max_steps=100)
        y0 = jax.tree.map(jnp.asarray, problem.y0)
        kept = dfx.SaveAt(t1=True, solver_state=True)
        first = mj.diffeqsolve(problem.terms, solver, start, 1.0, None, y0, saveat=kept, **options)
        saveat = dfx.SaveAt(t1=True) if second == "end" else dfx.SaveAt(ts=jnp.array([1.03, 1.5]))
        sol = mj.diffeqsolve(
            problem.terms,
            solver,
            1.0,
            1.5,
            0.05,
            jax.tree.map(lambda y: y[-1], first.ys),
            saveat=saveat,
            solver_state=first.solver_state,
            consistent="assume",
            **{**options, "args": args._replace(gravity=2 * gravity)},
        )
        return sum(jnp.sum(jnp.sin(y)) for y in sol.ys)

    at = jnp.array([9.81, 0.1])
    reverse = jax.jit(jax.grad(value))(at)
    forward = jax.jit(jax.jacfwd(value))(at)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)


def test_reverse_mode_of_a_derivative():
    """There is no loop that could be repeated backwards: the message says what to write."""

    def end(rate):
        term, at = dfx.ODETerm(lambda t, y, rate: -rate * y), jnp.array(1.0)
        return mj.diffeqsolve(term, dfx.Tsit5(), 0.0, 1.0, 0.25, at, rate).ys[0]

    gradient = jax.grad(end)
    assert jax.jit(jax.jacfwd(gradient))(0.7) == pytest.approx(np.exp(-0.7), abs=1e-4)
    tangent = lambda rate: jax.jvp(end, (rate,), (1.0,))[1]
    batch = lambda rate: jnp.sum(jax.vmap(gradient)(jnp.stack([rate, rate])))
    for derivative in (gradient, jax.jit(gradient), tangent, batch):
        with pytest.raises(RuntimeError, match=r"Write `jax.jacfwd\(jax.grad\(f\)\)`"):
            jax.grad(derivative)(0.7)


def test_steps_across_jumps_of_the_field():
    """The state after a jump starts a new step just behind it."""

    def end(theta, adjoint):
        field = lambda t, y, args: theta * jnp.where(t < 0.5, 1.0, -3.0) * jnp.stack([-y[1], y[0]])
        controller = dfx.ClipStepSizeController(
            dfx.PIDController(rtol=1e-8, atol=1e-8), jump_ts=jnp.array([0.5])
        )
        circle = mj.Constraint(lambda t, y, args: y @ y - 1.0)
        sol = mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.Projected(dfx.Bosh3(), circle),
            0.0,
            1.0,
            0.1,
            jnp.array([1.0, 0.0]),
            stepsize_controller=controller,
            adjoint=adjoint,
        )
        return sol.ys[0, 1]

    reverse = jax.jit(jax.grad(lambda theta: end(theta, mj.StepReplayAdjoint())))(1.0)
    forward = jax.jit(jax.jacfwd(lambda theta: end(theta, dfx.ForwardMode())))(1.0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    np.testing.assert_allclose(reverse, -np.cos(1.0), rtol=1e-6)  # y(1) = -sin(theta)


def turn_with_a_switch(switch, rates, controller, **options):
    """A point that turns at one rate before the time `switch` and at another one after it."""
    circle = mj.Constraint(lambda t, y, args: y @ y - 1.0)
    rate = lambda t, switch: jnp.where(t < switch, *rates)
    field = lambda t, y, switch: rate(t, switch) * jnp.stack([-y[1], y[0]])
    parts = dfx.ODETerm(field), mj.Projected(dfx.Tsit5(), circle), 0.0, 1.0, None
    options |= dict(stepsize_controller=controller)
    return mj.diffeqsolve(*parts, jnp.array([1.0, 0.0]), switch, **options)


def test_jumps_at_a_parameter():
    """The ends of steps just before and just behind it move with it; one at infinity is never met."""

    def heights(switch):
        controller = dfx.PIDController(rtol=1e-9, atol=1e-9)
        jump_ts = jnp.stack([jnp.array(jnp.inf), switch])
        controller = dfx.ClipStepSizeController(controller, jump_ts=jump_ts)
        saveat = dfx.SaveAt(ts=jnp.array([0.2, 0.7, 1.0]), dense=True)
        sol = turn_with_a_switch(switch, (0.7, -1.4), controller, saveat=saveat)
        return jnp.append(sol.ys[:, 1], sol.evaluate(0.9)[1])

    # The angle is 0.7 t, and behind the switch 0.7 (3 switch - 2 t).
    switch, t = jnp.array(0.5), np.array([0.2, 0.7, 1.0, 0.9])
    slopes = np.where(t < 0.5, 0.0, 2.1 * np.cos(0.7 * (1.5 - 2 * t)))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(heights))(switch), slopes, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.jacrev(heights))(switch), slopes, atol=1e-7)
    second = jax.jit(jax.jacfwd(jax.grad(lambda switch: heights(switch)[2])))(switch)
    np.testing.assert_allclose(second, -(2.1**2) * np.sin(0.7 * -0.5), rtol=1e-6)


@pytest.mark.parametrize("dense", [False, True])
def test_times_to_step_to(dense):
    """Have derivatives of the size of the error of so few steps, as in plain forward mode."""

    def turned(times, adjoint):
        controller = dfx.StepTo(ts=jnp.concatenate([jnp.zeros(1), times, jnp.ones(1)]))
        saveat = dfx.SaveAt(t1=True, dense=dense)
        options = dict(adjoint=adjoint, max_steps=4, saveat=saveat)
        sol = turn_with_a_switch(0.5, (2.0, 2.0), controller, **options)
        return (sol.evaluate(0.7) if dense else sol.ys[-1]) @ jnp.array([1.0, 2.0])

    times = jnp.array([0.3, 0.8])
    slopes = jax.jit(jax.jacfwd(lambda times: turned(times, dfx.ForwardMode())))(times)
    assert np.abs(slopes).min() > 1e-6
    for derivative in (jax.jacrev, jax.jacfwd):
        found = jax.jit(derivative(lambda times: turned(times, mj.StepReplayAdjoint())))(times)
        np.testing.assert_allclose(found, slopes, rtol=1e-9)


@pytest.mark.slow
def test_network_as_vector_field():
    """Many parameters: leaves of a module inside the terms."""
    network = eqx.nn.MLP(3, 3, 8, 2, key=jax.random.key(1))
    sphere = mj.Constraint(lambda t, y, args: y @ y - 1.0)

    def end(network, adjoint):
        field = lambda t, y, args: jnp.cross(network(y), y)
        sol = mj.diffeqsolve(
            dfx.ODETerm(field),
            mj.Projected(dfx.Tsit5(), sphere),
            0.0,
            3.0,
            None,
            jnp.array([0.6, 0.0, 0.8]),
            stepsize_controller=CONTROLLER,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 3.0, 9)),
            adjoint=adjoint,
        )
        return jnp.sum(sol.ys[:, 0] * jnp.arange(9.0))

    replayed = eqx.filter_grad(end)(network, mj.StepReplayAdjoint())
    checkpointed = eqx.filter_grad(end)(network, dfx.RecursiveCheckpointAdjoint())
    for a, b in zip(jax.tree.leaves(replayed), jax.tree.leaves(checkpointed)):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_states():
    """Compiled, the room for states is `checkpoints` and one block, whatever `max_steps`. Of a state at
    the end no vector field is recorded."""

    def bytes_needed(max_steps, checkpoints):
        adjoint = mj.StepReplayAdjoint(checkpoints=checkpoints)
        case = (mj.Projected, "t1", dfx.Tsit5())
        gradient = reverse_mode(*case, replay=adjoint, max_steps=max_steps)
        return (
            jax.jit(lambda theta: gradient(theta, 1.0)[0])
            .lower(THETA)
            .compile()
            .memory_analysis()
            .temp_size_in_bytes
        )

    few, many = bytes_needed(2**14, 128), bytes_needed(2**14, 2**14)
    times, state = 3 * 8 * 2**14, 2 * 8  # and whether they were accepted
    assert few < times + 2 * 2 * 128 * state + 50_000
    assert many > times + 2**14 * state


@jax.custom_jvp
def rounded(x):
    """An error so large that it decides on the sizes of steps, and that is another in forward mode."""
    return x * (1 + 1e-7 * jnp.sin(1e8 * x))


rounded.defjvp(lambda x, dx: (x[0] * (1 + 1e-7 * jnp.sin(1.3e8 * x[0])), dx[0]))


def test_forward_mode_repeats_the_steps_that_were_made():
    """What is saved at the ends of steps, and an event inside of one, is that of the first solve. (Steps of
    the first solve and of its repetition differ as soon as their errors are as small as rounding; here
    that is enlarged.)"""
    controller = dfx.PIDController(rtol=1e-9, atol=1e-9)
    controller = dfx.ClipStepSizeController(controller, jump_ts=jnp.array([0.31, 0.7]))
    event = dfx.Event(lambda t, y, args, **_: y - 2.0, optx.Newton(1e-12, 1e-12))

    def values(rate):
        field = dfx.ODETerm(lambda t, y, args: rate * rounded(y) * jnp.cos(t))
        saveat = dfx.SaveAt(subs=[dfx.SubSaveAt(steps=True), dfx.SubSaveAt(t1=True)])
        given = dict(stepsize_controller=controller, saveat=saveat, event=event, max_steps=300)
        sol = mj.diffeqsolve(field, dfx.Tsit5(), 0.0, 1.5, None, jnp.array(1.0), **given)
        (times, _), (_, end) = sol.ts, sol.ys
        last = jnp.argmax(jnp.where(jnp.isfinite(times), times, -1.0))
        kept = jnp.arange(len(times)) < last
        return jnp.stack([jnp.sum(jnp.where(kept, sol.ys[0], 0.0)), sol.ts[1][0]]), end

    (steps, time), _ = jax.jit(jax.jacrev(values, has_aux=True))(1.2)
    forward, end = jax.jit(jax.jacfwd(values, has_aux=True))(1.2)
    np.testing.assert_allclose(forward, [steps, time], rtol=1e-6)
    np.testing.assert_allclose(end, 2.0, rtol=1e-12)
    # y = exp(rate sin t) is 2 at sin t = log(2) / rate.
    sine = np.log(2) / 1.2
    np.testing.assert_allclose(time, -sine / 1.2 / np.sqrt(1 - sine**2), rtol=1e-5)


@pytest.mark.parametrize("checkpoints", [None, 2])
def test_second_derivative_with_rejected_steps(checkpoints):
    """Forward over reverse mode: the tangents of the recorded states are those of the same rows."""
    controller = dfx.PIDController(rtol=1e-5, atol=1e-8)

    def end(p, adjoint):
        bump = lambda t: 3 * jnp.exp(-200 * (t - 1) ** 2)
        field = lambda t, y, args: jnp.stack([p * y[1] + bump(t) * y[0] ** 2, -p * y[0]])
        given = dict(stepsize_controller=controller, max_steps=50, adjoint=adjoint)
        y0 = jnp.array([1.0, 0.2])
        sol = mj.diffeqsolve(dfx.ODETerm(field), dfx.Tsit5(), 0.0, 3.0, 0.3, y0, **given)
        return sol.ys[0, 0], sol.stats["num_rejected_steps"]

    adjoint = mj.StepReplayAdjoint(checkpoints)
    second = lambda first: jax.jit(jax.jacfwd(first, has_aux=True))(1.3)
    over_reverse, rejected = second(jax.grad(lambda p: end(p, adjoint), has_aux=True))
    over_forward, _ = second(jax.jacfwd(lambda p: end(p, dfx.ForwardMode()), has_aux=True))
    assert rejected > 3
    np.testing.assert_allclose(over_reverse, over_forward, rtol=1e-11)
