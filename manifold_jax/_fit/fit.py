"""The front end: fits parameters of an equation on a manifold to measured trajectories."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from .._base.numbers import by_precision
from .._resets.reset import check_resets
from .data import check_times, make_records
from .model import as_function_of_constraint, Simulator
from .optimize import Options
from .parameters import make_transform
from .pieces import make_pieces
from .progress import FitMeter
from .report import FitResult
from .setup import check_initial, check_options, make_objective, refuse_tracers
from .starts import choose, draw_points, optimize_all, see, with_scales
from .summary import summarize


def fit(
    model: Any,
    parameters: Any,
    ts: Any,
    data: Any,
    *,
    y0: Any = None,
    t0: Any = None,
    observe: Callable | None = None,
    sigma: Any = None,
    missing: str | None = None,
    bounds: Any = None,
    positive: Any = False,
    fit_initial: bool = False,
    loss: Callable | None = None,
    optimizer: Any = None,
    steps: int = 200,
    patience: int = 20,
    batch_size: int | None = None,
    seed: int = 0,
    starts: int = 1,
    segments: int = 1,
    states: Any = None,
    solver: Any = dfx.Tsit5(),  # noqa: B008
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    dt0: Any = None,
    max_steps: int | None = 4096,
    resets: Any = (),
    max_resets: int = 100,
    progress: bool = False,
    throw: bool = True,
) -> FitResult:
    r"""Fit parameters to measured trajectories, by default by weighted least squares:

    $$\min_\theta \tfrac12 \sum_{r,i,j}
    \left(\frac{h_j(t_i, y_r(t_i; \theta), \theta) - d_{rij}}{\sigma_{rij}}\right)^2.$$

    ```python
    problem = mj.problems.pendulum()
    start = {"gravity": 8.0, "length": 1.3}
    result = mj.fit(problem, start, ts, (q_measured, v_measured), sigma=0.01)
    print(result)
    ```

    Parameters may be anywhere: in the vector field, inside the constraint, in the initial
    state. The problem is rebuilt from them inside the function that is differentiated, so that
    sensitivities are complete.

    **Arguments:**

    - `model`: a problem of the gallery (`parameters` is then a dictionary with some of the
        fields of its `args`); an [`MechanicalSystem`][] (`parameters` is then its `args`); or a
        function of the parameters that returns one of these or `(terms, constraint)`, which get
        the parameters as `args`; `terms` alone for an equation without constraints. Define such
        a function once: calls with the same one share compiled code. [`Invariants`][] are frozen anew at the initial state of each solve.
    - `parameters`: the values to start from, any pytree of real numbers and arrays, `p` in all. Steps are
        relative to them (absolute from 0): of one that starts many orders of magnitude too small, nothing is seen.
    - `ts`: increasing times of the measurements, shape `(times,)`; or `(records, times)` for
        many trajectories with the same parameters.
    - `data`: the measurements at `ts`, like the state (or what `observe` returns), leaves
        with a leading axis `(times,)` or `(records, times)`.
    - `y0`: the initial state at `t0`, with a leading axis `(records,)` if there are many; or a
        function `y0(parameters)`. It is moved onto the manifold. Default: that of the problem.
    - `t0`: the time of `y0`, by default the problem's, otherwise the first of `ts`.
    - `observe`: `h(t, y, parameters)`, any pytree. Default: the whole state.
    - `sigma`: standard deviations of the measurements, in the units of `data`: a number, or the structure of
        `data`. If `None`, all are taken as equal and estimated from the residuals.
    - `missing`: `"nan"` says that values that are NaN were not measured; otherwise refused.
    - `bounds`: `(lower, upper)`, each a number or like `parameters`; `positive`: `True`, or
        like `parameters`, for a lower bound of 0. Kept by a change of variables; a positive
        parameter is searched for on a logarithmic scale, one that is driven to a bound put on it.
    - `fit_initial`: whether initial states are unknown, too, each with as many unknowns as the
        manifold has dimensions; `y0` is then the guess, near enough to be left along the
        tangent space. The matrices grow with the number of records.
    - `loss`: instead of squares, `loss(prediction, data, weights)` of one record, to be summed
        over records; `weights` are `1 / sigma`, and 0 where a value is missing.
    - `optimizer`: an Optimistix least-squares solver (default: Levenberg-Marquardt) or minimizer
        (`optx.BFGS`), or any Optax optimizer. Steps of the unknowns are relative to the start
        values. Prefer the default, but Optax for more than about 50 parameters (then by reverse
        mode and without standard errors) or more records than can be solved in each step.
    - `steps`: the largest number of steps; `patience`: stop after so many without a decrease.
    - `batch_size`: with Optax, records in each step, in an order drawn with `seed`; `steps` then counts
        passes through all records.
    - `starts`: how many times to fit, of which the best is kept and all are listed
        (`result.starts`): from `parameters`, and from those points with the lowest losses of eight
        times as many, a Latin hypercube around `parameters` drawn with `seed`. In it a parameter with
        two bounds is anywhere between them; with one, `positive` for instance, up to 3 times nearer to
        it or farther away; without, between 0 and twice its start value (-1 and 1 if that is 0). Use it
        where a fit ends in a local minimum. All starts share one compiled program.
    - `segments`: multiple shooting, into how many pieces to cut each record. The states where they
        begin are further unknowns on the manifold, which meet the ends of the pieces before
        them in the end. Use it for long records of oscillating or chaotic motion, where
        single shooting ends in a local minimum; pieces of about one characteristic time.
        Guesses of those states are taken from `data` if it is the state, else from `states`
        (like the state with the leading axes of `ts`), else from a solve.
    - `solver`: a Diffrax solver, wrapped in [`Projected`][], or a function of the constraint.
    - `stepsize_controller`, `dt0`, `max_steps`: as for [`diffeqsolve`][]. The default tolerance
        is 1e-8 (1e-5 in single precision).
    - `resets`, `max_resets`: jumps of the state as for [`diffeqsolve`][], in all records; their functions get
        the `args` that the vector field gets. For one segment.
    - `progress`: whether to report compilation and steps: by a progress bar
        on a terminal, by lines in a file or a notebook.
    - `throw`: whether a fit that did not end well raises; otherwise look at `result.success`.

    Not to be called inside `jit` or `vmap`: the optimizer's loop runs in Python, its steps are
    compiled. A trajectory whose solve fails counts as a large constant: a step into such parameters is
    rejected, and a record that fails all the time has no influence and is reported.

    **Returns:**

    A [`FitResult`][]: `parameters`, `standard_errors` and `covariance` (`s^2 (J^T J)^-1`
    with the Jacobian `J` of the weighted residuals and `s = 1` if `sigma` is given, else the estimated noise), with
    `sigma` given the verdict of a chi-squared
    test (`fits`, `probability`), history, report (`print`) and `plot`.

    **Raises:**

    `TypeError` or `ValueError` for arguments that cannot work; with `throw=True` a
    `RuntimeError` if the optimizer did not converge.

    Sources: Seber & Wild, Nonlinear Regression (1989); multiple shooting: Bock, in Numerical
    Treatment of Inverse Problems in Differential and Integral Equations (1983), 95-121.
    """
    refuse_tracers(
        model=model, parameters=parameters, ts=ts, data=data, y0=y0, sigma=sigma, states=states
    )
    check_times(ts)
    solver = as_function_of_constraint(solver)
    transform = make_transform(parameters, bounds, positive)
    if stepsize_controller is None:
        tolerance = by_precision(None, jnp.result_type(float), 1e-8, 1e-5)
        stepsize_controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
    if optimizer is None:
        tolerance = by_precision(None, jnp.result_type(float), 1e-7, 1e-3)
        optimizer = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    check_resets(resets, max_resets, None)
    solves = solver, stepsize_controller, dt0, tuple(resets), max_steps, max_resets
    simulator = Simulator(model, transform, y0, observe, *solves, many=np.ndim(ts) == 2)
    check_initial(simulator, np.shape(ts))
    start = transform.unravel(transform.start)
    y = simulator.given().y0
    observed = eqx.filter_eval_shape(simulator.observation, jnp.zeros(()), y, start)
    t0 = getattr(model, "t0", None) if t0 is None and hasattr(model, "with_args") else t0
    records = make_records(ts, data, sigma, missing, t0, observed)
    meter = FitMeter(progress)
    options = Options(optimizer, steps, patience, batch_size, seed, starts, meter)
    check_options(options, loss, segments, records)
    if resets and segments != 1:
        raise ValueError(
            f"`segments` must be 1 with `resets`, which may happen where a segment begins, got {segments!r}. Give "
            "`parameters` or several `starts` that are closer."
        )
    with meter:
        with meter.compiling("the solves"):
            pieces = make_pieces(records, segments, simulator, states, fit_initial)
            objective = make_objective(simulator, records, pieces, loss, fit_initial, options)
            points = _unknowns(objective, options)
            given = see(points[0], objective, options)
        points, losses = choose(points, given, objective, options)
        objective = with_scales(objective, losses)
        outcome, table = optimize_all(objective, points, losses, options)
        with meter.compiling("the standard errors"):
            result = summarize(objective, outcome, table, records)
    if throw and not result.success:
        raise RuntimeError(
            f"The fit failed: {result.message}. Start closer or several times (`starts=8`), give "
            "`bounds`, allow more `steps`, or cut long records into `segments`; with `throw=False` "
            "the result is returned."
        )
    return result


def _unknowns(objective: Any, options: Options) -> list[Any]:
    """Return the unknowns at all starts: of the parameters, then of initial states (at their guess)."""
    transform, d = objective.transform, objective.pieces.basis.shape[-1]
    states = objective.free.size * d
    # Each joint has as many equations as the state there has unknowns.
    unknowns = transform.start.size + states - objective.joints.size * d
    values = int(jnp.sum(objective.pieces.weights > 0))
    if values < unknowns:
        raise ValueError(
            f"`data` has {values} observed values for {unknowns} unknowns. Fit fewer "
            "`parameters`, or measure more."
        )
    drawn = np.pad(draw_points(transform, options.starts, options.seed), ((0, 0), (0, states)))
    return [jnp.asarray(u, transform.start.dtype) for u in drawn]
