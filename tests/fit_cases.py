"""Systems with known parameters, and measurements simulated from them, for the tests of `fit`."""

import json
import sys
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


# A point on a circle, `y = r (cos(w t + a), sin(w t + a))`: rate in the field, radius in the constraint.
TURN = dfx.ODETerm(lambda t, y, args: args["rate"] * jnp.stack([-y[1], y[0]]))
CIRCLE = mj.Constraint(lambda t, y, args: y @ y - args["radius"] ** 2)
TRUTH = {"rate": 1.5, "radius": 2.0}
START = {"rate": 1.1, "radius": 2.6}
TS = np.linspace(0, 4, 31)
Y0 = np.array([1.0, 0.0])  # moved onto the circle


BUILT = []  # grows with every call of the model, and so with every program that is compiled


def circle(parameters):
    BUILT.append(parameters)
    return TURN, CIRCLE


def positions(ts, rate=1.5, radius=2.0, angle=0.0):
    return radius * np.stack([np.cos(rate * ts + angle), np.sin(rate * ts + angle)], axis=-1)


def noisy(data, size, seed=0):
    return data + size * np.random.default_rng(seed).normal(size=data.shape)


def fit_circle(data, parameters=START, ts=TS, model=circle, **options):
    return mj.fit(model, parameters, ts, data, **{"y0": Y0, **options})


class Case(NamedTuple):
    """What `mj.fit` needs; `sigma` like the data, `truth` like the parameters."""

    model: Any
    truth: Any
    ts: np.ndarray
    sigma: Any
    options: dict


def _weight(t, q, v, args):
    return jnp.stack([jnp.zeros_like(args["gravity"]), -args["gravity"]]) - args["damping"] * v


def _hanging(args):
    return args["length"] * jnp.array([0.8, -0.6]), jnp.zeros(2)


def damped_pendulum():
    """Unit mass; the length is in the constraint and in the initial state."""
    rod = lambda t, q, args: q @ q - args["length"] ** 2
    system = mj.MechanicalSystem(1.0, rod, _weight)
    truth = {"gravity": 9.81, "length": 1.0, "damping": 0.3}
    options = dict(y0=_hanging, positive=True)
    return Case(system, truth, np.linspace(0, 2.5, 51), (0.01, 0.05), options)


def slider_crank():
    truth = {"stiffness": 1.0, "damping": 1.0}
    return Case(
        mj.problems.slider_crank(), truth, np.linspace(0, 10, 51), 0.02, dict(positive=True)
    )


ALL = {
    "pendulum": damped_pendulum,
    "slider-crank": slider_crank,
}


def exact_data(case):
    """Far more accurate than the fits are: another method, at 1e-12."""
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), case.truth)
    built = case.model
    if not isinstance(built, mj.MechanicalSystem):
        built = (
            built(parameters)
            if callable(built)
            else built.with_args(built.args._replace(**parameters))
        )
    y0 = case.options["y0"](parameters) if "y0" in case.options else built.y0
    sol = mj.diffeqsolve(
        built.terms,
        mj.Projected(dfx.Dopri8(), built.constraint),
        case.ts[0],
        case.ts[-1],
        None,
        y0,
        parameters if isinstance(built, mj.MechanicalSystem) else built.args,
        saveat=dfx.SaveAt(ts=jnp.asarray(case.ts)),
        stepsize_controller=dfx.PIDController(rtol=1e-12, atol=1e-12),
        max_steps=100000,
    )
    observe = case.options.get("observe", lambda t, y, p: y)
    return jax.tree.map(
        np.asarray, jax.vmap(lambda t, y: observe(t, y, parameters))(sol.ts, sol.ys)
    )


def with_noise(case, data, rng):
    sigma = (
        case.sigma if isinstance(case.sigma, tuple) else jax.tree.map(lambda _: case.sigma, data)
    )
    return jax.tree.map(lambda d, s: d + s * rng.normal(size=d.shape), data, sigma)


def start_off(case, rng, amount=0.3):
    """Every number wrong by `amount`, up or down."""
    off = lambda leaf: leaf * (1 + amount * rng.choice([-1.0, 1.0], size=np.shape(leaf)))
    return jax.tree.map(off, case.truth)


def flat(tree):
    return np.asarray(jfu.ravel_pytree(tree)[0])


def coverage(name):
    """40 repetitions, each from 30 % off; a failed fit is a miss. And one without noise."""
    case = ALL[name]()
    data, covered = exact_data(case), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        start, measured = start_off(case, rng), with_noise(case, data, rng)
        result = mj.fit(
            case.model, start, case.ts, measured, sigma=case.sigma, throw=False, **case.options
        )
        errors = flat(result.standard_errors)
        within = np.abs(flat(result.parameters) - flat(case.truth)) <= 2 * errors
        covered.append(within & np.isfinite(errors) & result.success)
    control = dfx.PIDController(rtol=1e-10, atol=1e-10)
    options = dict(stepsize_controller=control, max_steps=20000, **case.options)
    exact = mj.fit(case.model, start, case.ts, data, **options)
    error = np.max(np.abs(flat(exact.parameters) / flat(case.truth) - 1))
    return dict(zip(result.names, np.mean(covered, axis=0).tolist())), float(error)


def chaotic():
    """A double pendulum that goes over the top; errors grow by 4e4 within the record. Errors of
    single and of multiple shooting, standard errors, and the noise it found."""
    problem = mj.problems.double_pendulum(angles=(2.0, 2.5))
    ts = np.linspace(0, 10, 201)
    rng = np.random.default_rng(0)
    q, v = problem.reference(ts)
    data = q + 0.01 * rng.normal(size=q.shape), v + 0.05 * rng.normal(size=v.shape)
    start = {"gravity": 9.81 * 1.3, "lengths": np.array([0.7, 1.3])}
    truth = np.array([9.81, 1.0, 1.0])
    options = dict(sigma=(0.01, 0.05), positive=True, throw=False)
    single = mj.fit(problem, start, ts, data, **options)
    result = mj.fit(problem, start, ts, data, segments=20, **options)
    relative = lambda fit: (flat(fit.parameters) / truth - 1).tolist()
    standard = (flat(result.standard_errors) / truth).tolist()
    return relative(single), relative(result), standard, float(result.noise), bool(result.success)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(chaotic() if sys.argv[1] == "chaotic" else coverage(sys.argv[1])))
