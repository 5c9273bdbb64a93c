"""Every problem x solver at tolerance 1e-8: on the manifold everywhere, and accurate.

Violations and errors are recomputed in NumPy from the returned values.
`pytest -s -n 0 tests/test_gallery.py` prints the table.
"""

import functools

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import numpy_residuals
import optimistix as optx
import outside
import pytest
from variants import variants

import manifold_jax as mj


TOLERANCE = 1e-8
# Largest state error, in units of tolerance x (1 + |y|), norms of the whole state.
# Kvaerno5 with accurate stages (`optimistix.Newton`) has 432 on the pendulum (412 steps) and 381 on
# the car's axis without a projection; with one 720 and 377.
ALLOWED = {"bosh3": 2000, "tsit5": 300, "dopri5": 300, "dopri8": 300, "kvaerno5": 1000}
SOLVERS = {
    "bosh3": (dfx.Bosh3(), 16384),
    "tsit5": (dfx.Tsit5(), 4096),
    "dopri5": (dfx.Dopri5(), 4096),
    "dopri8": (dfx.Dopri8(), 4096),
    "kvaerno5": (dfx.Kvaerno5(), 16384),
}
MECHANISMS = [
    "double-pendulum",
    "chain",
    "slider-crank",
    "four-bar",
    "parallelogram",
    "spherical-pendulum",
    "heavy-top",
    "rolling-disc",
]
FIRST = [name for name in mj.problems.ALL if name not in MECHANISMS]
EVERY = [("outside", solver) for solver in SOLVERS]
# Each problem with one solver; those that are compiled fast with another in turn, so that each solver meets
# several problems.
OTHERS = ("bosh3", "dopri5", "dopri8", "kvaerno5")
EVERY += [(name, "tsit5") for name in mj.problems.ALL]
EVERY += [(name, OTHERS[i % len(OTHERS)]) for i, name in enumerate(FIRST)]
# By default the problem from outside with all of them, and one of each kind of problem.
KINDS = {"pendulum", "rigid-body", "kepler", "sphere-flow", "skate", "four-bar", "heavy-top"}


def cases(kind):
    """Pairs of problem and solver, most of them in the slow part. Solutions with every solver; steps and
    events, which do not depend on it, with one, but for the problem from outside; events of one problem of
    each kind."""
    return [
        pytest.param(
            name,
            solver,
            marks=() if _is_default(kind, name, solver) else pytest.mark.slow,
        )
        for name, solver in EVERY
        if kind == "accurate" or solver == "tsit5" or (name, solver) in ALSO
        if kind != "events" or name in KINDS_OF_EVENTS
    ]


def _is_default(kind, name, solver):
    if kind == "accurate":
        return name == "outside" or (name in KINDS and solver == "tsit5")
    return name == "outside" or (name, solver) in ALSO


ALSO = {("outside", "kvaerno5"), ("pendulum", "tsit5")}
KINDS_OF_EVENTS = KINDS | {"outside", "car-axis", "jay2", "rolling-disc"}


class Case:
    """One problem in the form the tests below need."""

    def __init__(self, name):
        self.name = name
        if name == "outside":
            self.terms, self.constraint, self.y0 = (
                outside.terms(),
                outside.constraint(),
                outside.y0(),
            )
            self.t0, self.t1, self.args = outside.T0, outside.T1, outside.parameters()
            self.residual, self.reference, self.end_only = (
                outside.residual_numpy,
                outside.exact,
                False,
            )
        else:
            problem = mj.problems.ALL[name]()
            self.terms, self.constraint, self.y0 = problem.terms, problem.constraint, problem.y0
            self.t0, self.t1, self.args = problem.t0, problem.t1, problem.args
            self.residual = getattr(numpy_residuals, name.replace("-", "_"))
            self.reference, self.end_only = problem.reference, problem.reference_at_end_only

    def violation(self, t, y):
        used = np.isfinite(np.asarray(t))
        take = lambda leaf: np.asarray(leaf)[used]
        assert used.any()
        return np.abs(self.residual(take(t), jax.tree.map(take, y))).max()

    def options(self, solver):
        return dict(
            args=self.args,
            stepsize_controller=dfx.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=SOLVERS[solver][1],
        )

    @functools.cached_property
    def event_function(self):
        """Where some component of y crosses the middle of its range, or of the ends where nothing
        else is known."""
        times = np.array([self.t1]) if self.end_only else np.linspace(self.t0, self.t1, 101)
        both = jax.tree.map(lambda a, b: np.r_[a[None], b], self.y0, self.reference(times))
        ys = np.concatenate([np.reshape(x, (len(x), -1)) for x in jax.tree.leaves(both)], axis=1)
        j = int(np.argmax(np.ptp(ys, axis=0)))
        middle = 0.5 * (ys[:, j].min() + ys[:, j].max())

        def cond_fn(t, y, args, **kwargs):
            return jfu.ravel_pytree(y)[0][j] - middle

        return cond_fn


@pytest.fixture(scope="module")
def case(request):
    return Case(request.param)


@pytest.mark.parametrize(("case", "solver"), cases("accurate"), indirect=["case"])
def test_on_the_manifold_and_accurate(case, solver):
    ts = jnp.linspace(case.t0, case.t1, 200)
    saveat = dfx.SaveAt(
        subs={
            "ts": dfx.SubSaveAt(ts=ts),  # the last of them is t1
            "steps": dfx.SubSaveAt(t0=True, steps=True),
        },
        dense=True,
    )
    sol = mj.diffeqsolve(
        case.terms,
        mj.Projected(SOLVERS[solver][0], case.constraint),
        case.t0,
        case.t1,
        None,
        case.y0,
        saveat=saveat,
        **case.options(solver),
    )
    for name in ("ts", "steps"):
        assert case.violation(sol.ts[name], sol.ys[name]) <= 1e-12, name
    times = case.t0 + (case.t1 - case.t0) * np.random.default_rng(0).uniform(size=1000)
    dense = jax.jit(jax.vmap(sol.evaluate))(jnp.asarray(times))
    assert case.violation(times, dense) <= 1e-12

    first = -1 if case.end_only else 0
    compared, values = ts[first:], jax.tree.map(lambda leaf: leaf[first:], sol.ys["ts"])
    reference = case.reference(np.asarray(compared))
    rows = lambda y: np.concatenate(
        [np.reshape(leaf, (len(compared), -1)) for leaf in jax.tree.leaves(y)], axis=1
    )
    exact, norm = rows(reference), lambda y: np.linalg.norm(y, axis=1)
    worst = np.max(norm(rows(values) - exact) / (1 + norm(exact))) / TOLERANCE
    steps = int(sol.stats["num_accepted_steps"])
    violation = case.violation(sol.ts["ts"], sol.ys["ts"])
    print(
        f"{solver:9s} steps {steps:6d}  violation {violation:.1e}  error / tol (1 + |y|) {worst:8.2f}"
    )
    assert worst <= ALLOWED[solver]


@pytest.mark.parametrize(("case", "solver"), cases("other"), indirect=["case"])
def test_steps_with_plain_diffrax(case, solver):
    sol = dfx.diffeqsolve(
        case.terms,
        mj.Projected(SOLVERS[solver][0], case.constraint),
        case.t0,
        case.t1,
        1e-3,
        case.y0,
        saveat=dfx.SaveAt(t0=True, steps=True, t1=True),
        **case.options(solver),
    )
    assert case.violation(sol.ts, sol.ys) <= 1e-12


@pytest.mark.parametrize(("case", "solver"), cases("events"), indirect=["case"])
def test_event_is_on_the_manifold(case, solver):
    cond_fn = case.event_function
    sol = mj.diffeqsolve(
        case.terms,
        mj.Projected(SOLVERS[solver][0], case.constraint),
        case.t0,
        case.t1,
        None,
        case.y0,
        event=dfx.Event(cond_fn, optx.Bisection(rtol=1e-12, atol=1e-12)),
        **case.options(solver),
    )
    assert sol.result == dfx.RESULTS.event_occurred
    assert case.t0 < float(sol.ts[0]) < case.t1
    assert case.violation(sol.ts, sol.ys) <= 1e-12
    assert abs(cond_fn(sol.ts[0], jax.tree.map(lambda leaf: leaf[0], sol.ys), case.args)) <= 1e-8


DIRECTIONS = [(name, "tsit5") for name in ("car-axis", "skate", "outside")]
MORE_DIRECTIONS = [("car-axis", "kvaerno5"), ("skate", "dopri8"), *EVERY[: len(SOLVERS)]]


@pytest.mark.parametrize(
    ("case", "solver"),
    variants(dict.fromkeys(DIRECTIONS + MORE_DIRECTIONS), DIRECTIONS),
    indirect=["case"],
)
def test_backward_in_time(case, solver):
    """Time-dependent constraints, from t1 back to t0; the start is the end of a forward run."""

    @jax.jit
    def solve(t0, t1, y0):
        steps, times = dfx.SubSaveAt(steps=True), dfx.SubSaveAt(ts=jnp.linspace(t0, t1, 200))
        return mj.diffeqsolve(
            case.terms,
            mj.Projected(SOLVERS[solver][0], case.constraint),
            t0,
            t1,
            None,
            y0,
            saveat=dfx.SaveAt(subs=[times, steps], dense=True),
            **case.options(solver),
        )

    forward = solve(case.t0, case.t1, case.y0)
    sol = solve(case.t1, case.t0, jax.tree.map(lambda leaf: leaf[-1], forward.ys[0]))
    assert case.violation(sol.ts[0], sol.ys[0]) <= 1e-12
    assert case.violation(sol.ts[1], sol.ys[1]) <= 1e-12
    times = np.random.default_rng(1).uniform(case.t0, case.t1, size=1000)
    assert case.violation(times, jax.jit(jax.vmap(sol.evaluate))(jnp.asarray(times))) <= 1e-12
    for back, start in zip(jax.tree.leaves(sol.ys[0]), jax.tree.leaves(case.y0)):
        assert np.abs(back[-1] - start).max() <= 1e-4
