"""Arguments of the wrong kind: what the user reads names the argument and what to write instead."""

import dataclasses
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import manifold_jax as mj


pytestmark = pytest.mark.usefixtures("as_a_user_meets_it")
CIRCLE = mj.Constraint(lambda t, y, args: y @ y - 1.0)
TURN = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
PROJECTED = mj.Projected(dfx.Tsit5(), CIRCLE)
START = jnp.array([1.0, 0.0])
SYSTEM = mj.MechanicalSystem(
    1.0, lambda t, q, args: q @ q - 1.0, lambda t, q, v, args: jnp.zeros(2)
)


def solve(terms=TURN, solver=PROJECTED, dt0=0.1, y0=START, t0=0.0, t1=1.0, **options):
    return mj.diffeqsolve(terms, solver, t0, t1, dt0, y0, **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(terms=SYSTEM), "`terms`.*`system.terms`"),
        (dict(terms=TURN.vector_field), r"`terms`.*diffrax.ODETerm\("),
        (dict(terms=None), r"`terms` is empty.*diffrax.ODETerm\("),
        (dict(terms=PROJECTED, solver=TURN), "`terms` is a Projected.*terms come first"),
        (dict(terms=dfx.ODETerm(lambda t, y: y)), r"`terms`.*`f\(t, y, args\)`.*`\(t, y\)`"),
        (dict(solver=dfx.Tsit5), "`solver`.*class Tsit5.*call it"),
        (dict(solver=CIRCLE), "`solver`.*got Constraint.*mj.Projected"),
        (dict(saveat=jnp.linspace(0.0, 1.0, 3)), r"`saveat`.*diffrax.SaveAt\(ts="),
        (dict(saveat=dfx.SaveAt(t1=True, fn=lambda y: y)), r"`saveat.fn`.*`fn\(t, y, args\)`"),
        (dict(stepsize_controller=1e-6), r"`stepsize_controller`.*diffrax.PIDController\("),
        (dict(adjoint="backsolve"), "`adjoint`.*'backsolve'.*mj.StepReplayAdjoint"),
        (dict(event=lambda t, y, args, **kwargs: y[0]), r"`event`.*diffrax.Event\(cond_fn\)"),
        (dict(event=dfx.Event(lambda t, y, args: y[0])), r"`event`.*\*\*kwargs"),
        (dict(t1="1"), "`t1` must be a real number, got '1'"),
        (dict(t0=None), "`t0` must be a real number, got NoneType"),
        (dict(dt0=0.1j), "`dt0` must be a real number, got one of type complex128"),
        (dict(solver=dfx.Tsit5(), y0="a"), "`y0` must be a pytree of real arrays.*str"),
        (dict(stepsize_controller=dfx.PIDController(rtol="a", atol=0)), "`rtol` of `stepsize_con"),
    ],
)
def test_arguments_of_the_wrong_kind(arguments, message):
    with pytest.raises(TypeError, match=f"(?s){message}"):
        solve(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(t0=jnp.zeros(2)), r"`t0` must be one number, got an array of shape \(2,\)"),
        (dict(t1=jnp.ones(2)), r"`t1` must be one number, got an array of shape \(2,\)"),
        (dict(dt0=jnp.ones(2)), r"`dt0` must be one number, got an array of shape \(2,\)"),
    ],
)
def test_times_that_are_no_single_number(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(**arguments)


@pytest.mark.parametrize(
    ("rtol", "atol", "message"),
    [
        (float("nan"), 1e-6, "`rtol` of `stepsize_controller` must not be negative or NaN"),
        (1e-6, jnp.array([1e-6, -1.0]), "`atol` of `stepsize_controller` must not be negative"),
        (0.0, 0.0, "`rtol` and `atol` of `stepsize_controller` are both zero"),
        (1e-6, jnp.ones(3), r"`atol` of `stepsize_controller`.*\(2,\), got shape \(3,\)"),
    ],
)
def test_tolerances_that_no_step_could_meet(rtol, atol, message):
    controller = dfx.PIDController(rtol=rtol, atol=atol)
    for wrapped in (controller, dfx.ClipStepSizeController(controller)):
        with pytest.raises(ValueError, match=message):
            solve(stepsize_controller=wrapped)
    with pytest.raises(ValueError, match=message):
        mj.solve_ensemble(
            TURN,
            PROJECTED,
            0.0,
            jnp.ones(3),
            None,
            jnp.ones((3, 2)),
            stepsize_controller=controller,
        )


def test_a_complex_vector_field_of_a_real_state():
    """It would lose its imaginary part."""
    message = r"The vector field in `terms` returns complex numbers.*\(z.real, z.imag\)"
    turning = lambda t, y, args: 1j * y.astype(complex)
    for solver in (PROJECTED, mj.Rodas5P(), dfx.Tsit5()):
        with pytest.raises(TypeError, match=message):
            solve(dfx.ODETerm(turning), solver)
    with pytest.raises(TypeError, match=message):
        solve(mj.MassMatrixTerm(turning, 1.0), mj.Rodas5P())
    with pytest.raises(TypeError, match=message):
        mj.solve_ensemble(dfx.ODETerm(turning), PROJECTED, 0.0, 1.0, 0.1, jnp.ones((3, 2)))


def test_constant_steps_of_no_size():
    with pytest.raises(ValueError, match=r"`dt0` is None.*diffrax.PIDController"):
        solve(dt0=None)


@pytest.mark.parametrize("dt0", [0, 0.0, float("nan")])
def test_a_first_step_of_no_length(dt0):
    for solver in (PROJECTED, dfx.Tsit5()):
        with pytest.raises(ValueError, match="`dt0` must be the length of the first step"):
            solve(solver=solver, dt0=dt0)


def test_implicit_adjoint_is_refused():
    with pytest.raises(ValueError, match=r"(?s)ImplicitAdjoint.*StepReplayAdjoint"):
        solve(adjoint=dfx.ImplicitAdjoint())


@pytest.mark.parametrize(
    "make",
    [
        lambda system: mj.Projected(dfx.Tsit5(), system),
        lambda system: mj.LocalCoordinates(dfx.Tsit5(), system),
        lambda system: mj.tangent_field(TURN.vector_field, system),
        lambda system: mj.project(system, 0.0, (START, START)),
        lambda system: mj.consistent_state(system, 0.0, (START, START)),
        lambda system: mj.constraint_violation(system, 0.0, (START, START)),
    ],
)
def test_a_system_instead_of_its_constraint(make):
    with pytest.raises(TypeError, match="`constraint`.*MechanicalSystem.*`system.constraint`"):
        make(SYSTEM)


def test_swapped_arguments():
    for function in (mj.project, mj.consistent_state, mj.constraint_violation):
        with pytest.raises(TypeError, match="missing a required argument: 'y'") as error:
            function(START, CIRCLE)
        assert f"mj.{function.__name__}` takes the arguments `(constraint, t, y" in str(error.value)
        with pytest.raises(TypeError, match=rf"order .* is `mj.{function.__name__}\(constraint, t"):
            function(START, 0.0, CIRCLE)
    with pytest.raises(TypeError, match=r"order .* is `mj.linearize\(terms, constraint, t"):
        mj.linearize(CIRCLE, SYSTEM.terms, 0.0, START)
    with pytest.raises(TypeError, match="got None. Without a constraint use the solver alone"):
        mj.Projected(dfx.Tsit5(), None)


def test_several_times_at_once():
    sol = solve(saveat=dfx.SaveAt(dense=True), max_steps=16)
    with pytest.raises(ValueError, match=r"`t0` must be one time.*jax.vmap\(sol.evaluate\)\(ts\)"):
        sol.evaluate(jnp.linspace(0.0, 1.0, 3))


two = lambda t, y: y
three = lambda t, q, args: q[0]
four = lambda t, q, v, args: q


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mj.Constraint(two), r"`function`.*`g\(t, y, args\)`.*`\(t, y\)`"),
        (lambda: mj.Invariants(two, y0=START), r"`function`.*`I\(t, y, args\)`"),
        (lambda: mj.tangent_field(two, CIRCLE), r"`function`.*`f\(t, y, args\)`"),
        (
            lambda: mj.MechanicalSystem(1.0, four, four),
            r"`position_constraint`.*`phi\(t, q, args\)`",
        ),
        (lambda: mj.MechanicalSystem(1.0, three, three), r"`force`.*`Q\(t, q, v, args\)`"),
        (lambda: mj.MechanicalSystem(three, three, four), r"`mass_matrix`.*`M\(q, args\)`"),
        (
            lambda: mj.MechanicalSystem(1.0, None, four, velocity_constraint=three),
            r"`velocity_constraint`.*`a\(t, q, v, args\)`",
        ),
        (
            lambda: mj.MechanicalSystem.from_lagrangian(three, three),
            r"`lagrangian`.*`L\(t, q, v, args\)`",
        ),
    ],
)
def test_functions_with_the_wrong_number_of_arguments(make, message):
    with pytest.raises(TypeError, match=message):
        make()


def test_functions_without_a_signature_are_taken_as_they_are():
    """`max` has none, and classes, partial functions and defaults are functions, too."""
    mj.Constraint(max)
    mj.Constraint(lambda t, y, args=None, scale=1.0: scale * y)
    mj.Constraint(lambda *args: args[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(metric="nearest"), "`metric` must be 'identity', 'error'"),
        (dict(metric=-1.0), "`metric` must have positive weights"),
        (dict(metric=(jnp.ones(2), np.array([1.0, 0.0]))), "`metric` must have positive weights"),
        (dict(max_steps=0), "`max_steps` must be a positive integer"),
        (dict(tolerance=0.0), "`tolerance` must be positive"),
        (dict(tolerance=-1e-9), "`tolerance` must be positive"),
        (dict(tolerance=float("nan")), "`tolerance` must be positive"),
    ],
)
def test_options_of_a_projection(options, message):
    with pytest.raises(ValueError, match=message):
        mj.NewtonProjection(**options)


def test_metrics_that_do_not_fit_the_state():
    flat, pair = START, (jnp.ones((2, 2)), jnp.ones(2))
    anywhere = mj.Constraint(lambda t, y, args: jnp.sum(y[0]) - 1.0)
    for metric, state, message in (
        ((1.0, 2.0), flat, "structure of the state"),
        (jnp.ones(3), flat, r"shape \(2,\) or \(\), got \(3,\)"),
        # Not spread over the columns: rows might have been meant.
        ((jnp.ones(2), 1.0), pair, r"shape \(2, 2\) or \(\), got \(2,\)"),
    ):
        with pytest.raises(ValueError, match=f"`metric`.*{message}"):
            mj.project(anywhere, 0.0, state, projection=mj.NewtonProjection(metric=metric))


def test_lists_of_numbers():
    for call, name in (
        (lambda y: solve(y0=y), "y0"),
        (lambda y: mj.project(CIRCLE, 0.0, y), "y"),
        (lambda y: mj.constraint_violation(CIRCLE, 0.0, y), "y"),
    ):
        for y in ([1.0, 0.0], ([1.0, 0.0], 2.0), [[1.0, 0.0], [0.0, 1.0]], [np.float64(1.0)]):
            with pytest.raises(TypeError, match=rf"`{name}` has a list of numbers.*jnp.array\("):
                call(y)


def test_states_of_another_shape_than_the_constraint_expects():
    pair = mj.Constraint(lambda t, y, args: y["q"] @ y["q"] - 1.0)
    with pytest.raises(TypeError) as error:
        mj.constraint_violation(pair, 0.0, START)
    assert "`constraint`" in error.value.__notes__[0]
    with pytest.raises(TypeError) as error:  # a trajectory without its times
        mj.constraint_violation(CIRCLE, 0.0, jnp.ones((5, 2)))
    assert "shapes (5, 2)" in error.value.__notes__[0]
    assert "sol.ts, sol.ys" in error.value.__notes__[0]


def test_one_state_where_an_ensemble_has_many():
    with pytest.raises(IndexError) as error:
        mj.solve_ensemble(TURN, dfx.Bosh3(), 0.0, 1.0, 0.1, START)
    assert (
        "Of the 2 trajectories of `y0s` each has a state of shapes ()" in error.value.__notes__[0]
    )


def test_arguments_of_an_ensemble_without_axes():
    """Their rows are taken for those of one trajectory; of a leaf with another number of rows nothing is said."""
    terms = dfx.ODETerm(lambda t, y, args: -args["rate"] * args["size"][0] * y)
    args = {"rate": jnp.ones(3), "size": jnp.ones(2)}
    given = terms, dfx.Bosh3(), 0.0, 1.0, 0.1
    with pytest.raises(ValueError, match=r"returns \(3,\).*of `args\['rate'\]`: if.*`args_axes=0`"):
        mj.solve_ensemble(*given, jnp.ones((3, 1)), args)
    with pytest.raises(ValueError, match="must be like the state") as error:
        mj.solve_ensemble(*given, jnp.ones((4, 1)), args)
    assert "args_axes" not in str(error.value)


@pytest.mark.parametrize("max_steps", [100.0, 0, -3, "many"])
def test_numbers_of_steps(max_steps):
    for solver in (PROJECTED, dfx.Heun()):
        with pytest.raises(ValueError, match="`max_steps` must be a positive integer"):
            solve(solver=solver, max_steps=max_steps)
    assert solve(max_steps=16).result == dfx.RESULTS.successful


def test_a_field_unlike_the_state():
    row = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]])[None])
    for solver in (PROJECTED, dfx.Heun()):
        with pytest.raises(ValueError, match=r"vector field.*\(2,\), but returns \(1, 2\)"):
            solve(terms=row, solver=solver)
    with pytest.raises(ValueError, match=r"vector field.*\(2,\), but returns \(1, 2\)"):
        mj.solve_ensemble(row, dfx.Heun(), 0.0, 1.0, 0.1, START[None])


@dataclasses.dataclass
class Unregistered:
    rate: float = 1.0


def test_parameters_into_which_jax_cannot_look():
    wrong = Unregistered()
    for call in (
        lambda: solve(args={"motor": wrong}),
        lambda: mj.solve_ensemble(
            TURN, dfx.Heun(), 0.0, 1.0, 0.1, START[None], wrong, args_axes=None
        ),
        lambda: mj.project(CIRCLE, 0.0, START, wrong),
    ):
        with pytest.raises(TypeError, match="`args` has a Unregistered.*register_dataclass"):
            call()


def test_an_event_function_that_is_nan():
    nowhere = lambda t, y, args, **kwargs: jnp.log(y[0] - 2.0)
    event = dfx.Event(nowhere, optimistix.Newton(1e-6, 1e-6))
    with pytest.raises(RuntimeError, match="met NaN: a function in `event`"):
        solve(event=event)


class Flat(mj.AbstractChart):
    """Coordinates of another shape than the state, and no `state`."""

    def at(self, constraint, projection, t, y, args):
        return Angle(jnp.zeros((), y.dtype), y)


class Angle(mj.AbstractCoordinates):
    origin: Any
    centre: Any

    def lift(self, t, w, args):
        c, s = jnp.cos(w), jnp.sin(w)
        x, y = self.centre
        p = jnp.stack([c * x - s * y, s * x + c * y])
        return p, mj.ProjectionInfo.of_nothing(p, jnp.asarray(True))

    def pull_back(self, t, w, y, vector):
        return y[0] * vector[1] - y[1] * vector[0]

    def push_forward(self, t, w, y, args, error):
        return error * jnp.stack([-y[1], y[0]])


def test_a_chart_whose_coordinates_are_no_states():
    solver = mj.LocalCoordinates(dfx.Heun(), CIRCLE, chart=Flat())
    for controller in (dfx.ConstantStepSize(), dfx.PIDController(1e-6, 1e-6)):
        with pytest.raises(ValueError, match=r"`chart=Flat`.*shape \(\).*\(2,\).*property `state`"):
            solve(solver=solver, stepsize_controller=controller)


def test_a_group_for_several_arrays():
    field = dfx.ODETerm(lambda t, y, args: y)
    constraint = mj.Product((mj.Stiefel(), None))
    solver = mj.LocalCoordinates(dfx.Heun(), constraint, chart=mj.LieGroupChart(mj.SO3()))
    with pytest.raises(ValueError, match="`groups` of `mj.LieGroupChart` must be like the state"):
        solve(terms=field, solver=solver, y0=(jnp.eye(3), START))


def test_a_vector_field_that_would_be_broadcast():
    field = dfx.ODETerm(lambda t, y, args: -y[:1])
    with pytest.raises(ValueError, match=r"of shape \(2,\), but returns \(1,\)"):
        mj.diffeqsolve(field, dfx.Heun(), 0.0, 1.0, 0.1, START)
    with pytest.raises(ValueError, match=r"of shape \(2,\), but returns \(1,\)"):
        mj.solve_ensemble(field, dfx.Heun(), 0.0, 1.0, 0.1, START[None])


@pytest.mark.parametrize(
    ("call", "new"),
    [
        (lambda: mj.MechanicalSystem(1.0, constraint=None, force=None), "position_constraint"),
        (lambda: mj.MechanicalSystem(1.0, None, None, further=abs), "auxiliary"),
        (lambda: mj.MechanicalSystem.from_lagrangian(abs, constraint=None), "position_constraint"),
        (
            lambda: mj.solve_ensemble(TURN, dfx.Heun(), 0, 1, 0.1, START[None], in_axes=0),
            "args_axes",
        ),
        (lambda: mj.stream_ensemble(abs, 2, out="folder"), "path"),
    ],
)
def test_renamed_arguments_say_their_new_name(call, new):
    with pytest.raises(TypeError, match=f"has been renamed: write `{new}="):
        call()
