"""A structure as a JAX function of one lane: what a user of the library would write."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx

import manifold_jax as mj

from ._fuzz_structure import IMPLICIT, SPLIT, Structure


# Where values are asked for, as fractions of a run, and where fields may jump.
FRACTIONS = np.array([0.0, 0.11, 0.37, 0.5, 0.73, 1.0])
JUMP = 0.37
MAX_STEPS = 4096
CODES = (
    "successful",
    "event_occurred",
    "max_steps_reached",
    "dt_min_reached",
    "nonlinear_divergence",
    "nonlinear_max_steps_reached",
)


def solve(structure: Structure, adjoint: Any = None, throw: bool = False) -> Callable[[Any], Any]:
    """A function of a lane: `start`, `end`, `y0`, `args`.

    It returns all `times` (k,) and `states` (k, n) that were handed out, the result `code` as an
    index into `CODES`, and the numbers of steps.
    """

    def run(lane: Any) -> Any:
        problem = _Problem(structure, lane)
        function, terms, solver = problem.approach()
        controller, dt0 = _controller(structure, lane)
        saveat, event, handed_out = _output(structure, lane)
        sol = function(
            terms,
            solver,
            lane["start"],
            lane["end"],
            dt0,
            _pack_state(structure, lane["y0"]),
            lane["args"],
            saveat=saveat,
            stepsize_controller=controller,
            event=event,
            max_steps=MAX_STEPS if structure.is_adaptive else structure.steps + 2,
            adjoint=dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
            throw=throw,
        )
        times, states = handed_out(sol)
        code = sum(
            (i + 1) * (sol.result == getattr(dfx.RESULTS, name)) for i, name in enumerate(CODES)
        )
        stats = {name: sol.stats[name] for name in ("num_steps", "num_accepted_steps")}
        return {"times": times, "states": states, "code": code - 1, **stats}

    return run


def _pack(layout: str, x: Any) -> Any:
    if layout == "scalars":
        return tuple(x[i] for i in range(x.size))
    if layout == "nested":
        return {"head": x[0], "rest": {"body": x[1:]}} if x.size > 1 else {"head": x[0]}
    if layout == "matrix":
        return x.reshape(-1, 2) if x.size % 2 == 0 else x[None]
    return {"all": x, "none": None} if layout == "with-none" else x


def _unpack(tree: Any) -> Any:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jtu.tree_leaves(tree)])


def _pack_state(structure: Structure, x: Any) -> Any:
    if not structure.family.mechanical:
        return _pack(structure.layout, x)
    q, v = jnp.split(x, 2)
    return _pack(structure.layout, q), _pack(structure.layout, v)


class _Problem:
    """Terms, constraint and solver of one lane."""

    def __init__(self, structure: Structure, lane: Any):
        self.structure, self.family, self.lane = structure, structure.family, lane

    def approach(self) -> tuple[Callable, Any, Any]:
        """What to call, and its first two arguments."""
        name, solver = self.structure.approach, self._inner_solver()
        constraint, terms = self._constraint_and_terms()
        projection, gain = self._projection(), 10.0 / self.family.span
        if name in ("baumgarte", "velocity"):
            return mj.diffeqsolve, terms, solver
        if name == "steps-only":
            return dfx.diffeqsolve, terms, mj.Projected(solver, constraint)
        if name in ("tangent", "partition"):
            charts = {"tangent": mj.TangentSpaceChart, "partition": mj.CoordinatePartitionChart}
            hook = mj.LocalCoordinates(solver, constraint, chart=charts[name]())
            return mj.diffeqsolve, terms, hook
        stabilizations = {
            "invariant": mj.InvariantStabilization(gain),
            "invariant-projected": mj.InvariantStabilization(gain, projected=True),
            "exact": mj.ExactStabilization(gain),
            "exact-0": mj.ExactStabilization(0),
        }
        if name in stabilizations:
            hook = mj.Stabilized(solver, constraint, stabilization=stabilizations[name])
            return mj.diffeqsolve, terms, hook
        return mj.diffeqsolve, terms, mj.Projected(solver, constraint, projection=projection)

    def _projection(self) -> mj.NewtonProjection | None:
        name, n = self.structure.approach, self.family.n
        if name == "error-metric":
            adaptive = self.structure.is_adaptive
            tolerances = {} if adaptive else {"rtol": 1e-6, "atol": 1e-6}
            return mj.NewtonProjection(metric="error", **tolerances)
        if name == "weights":
            weights = jnp.linspace(1.0, 3.0, n)
            return mj.NewtonProjection(metric=_pack_state(self.structure, weights))
        return mj.NewtonProjection(max_steps=1) if name == "one-step" else None

    def _inner_solver(self) -> dfx.AbstractSolver:
        name = self.structure.solver
        if name == "HalfSolver":
            return dfx.HalfSolver(dfx.Heun())
        if name in IMPLICIT + SPLIT and not self.structure.is_adaptive:
            return getattr(dfx, name)(root_finder=dfx.VeryChord(rtol=1e-10, atol=1e-10))
        return getattr(dfx, name)()

    def _constraint_and_terms(self) -> tuple[Any, Any]:
        if self.family.mechanical:
            system = self._system()
            return system.constraint, self._split(system.terms)
        pack = lambda x: _pack(self.structure.layout, x)
        constraint = self._constraint()
        if self.structure.own_field:
            raw = lambda t, y, args: pack(self.family.raw(jnp, t, _unpack(y), args))
            field = mj.tangent_field(raw, constraint)
        else:
            field = lambda t, y, args: pack(self.family.field(jnp, t, _unpack(y), args))
        return constraint, self._split(dfx.ODETerm(field))

    def _split(self, terms: Any) -> Any:
        if self.structure.solver not in SPLIT:
            return terms
        unit = jnp.ones(())
        part = lambda c: lambda t, y, args: jtu.tree_map(
            lambda f: c * f, terms.vf_prod(t, y, args, unit)
        )
        return dfx.MultiTerm(dfx.ODETerm(part(0.3)), dfx.ODETerm(part(0.7)))

    def _constraint(self) -> Any:
        family, lane = self.family, self.lane
        if family.conserves:
            function = lambda t, y, args: self._arranged(family.invariants(jnp, _unpack(y), args))
            y0 = _pack_state(self.structure, lane["y0"])
            return mj.Invariants(function, y0=y0, t0=lane["start"], args=lane["args"])
        return mj.Constraint(
            lambda t, y, args: self._arranged(
                self._spoilt(t, family.residual(jnp, t, _unpack(y), args), args)
            )
        )

    def _arranged(self, r: Any) -> Any:
        return (r[:1], {"rest": r[1:]}) if self.structure.residual_layout == "tuple" else r

    def _spoilt(self, t: Any, r: Any, args: Any) -> Any:
        """The residual, in one lane without a solution, or with an equation that says nothing."""
        if self.structure.failing == "impossible":
            passed = (t - args["start"]) / (args["end"] - args["start"])
            active = (passed > 0.5) & (args["spoilt"] > 0)
            # A constraint on velocities has to stay linear in them.
            never = 0 * r[0] + 1 if getattr(self.family, "rolls", False) else r[0] ** 2 + 1
            return r.at[0].set(jnp.where(active, never, r[0]))
        if self.structure.failing == "dependent":
            return r.at[0].multiply(1 - args["spoilt"])
        return r

    def _system(self) -> mj.MechanicalSystem:
        family, layout = self.family, self.structure.layout
        args = self.lane["args"]
        options: dict[str, Any] = {"redundant": getattr(family, "redundant", False)}
        if self.structure.approach == "baumgarte":
            options["stabilization"] = mj.Baumgarte(10.0, 10.0)
        if self.structure.approach == "velocity":
            options["stabilization"] = mj.VelocityStabilization()
        q0 = self.lane["y0"][: family.coordinates]
        holonomic = family.position(jnp, args["start"], q0, args)

        def position(t, q, args):
            phi = self._spoilt(t, family.position(jnp, t, _unpack(q), args), args)
            return self._arranged(jnp.append(phi, phi[:1]) if options["redundant"] else phi)

        def rolling(t, q, v, args):
            a = family.rolling(jnp, t, _unpack(q), _unpack(v), args)
            return a if holonomic is not None else self._spoilt(t, a, args)

        if family.rolls:
            options["velocity_constraint"] = rolling
        phi = None if holonomic is None else position
        if family.mass != "lagrangian":
            force = lambda t, q, v, args: _pack(
                layout, family.force(jnp, t, _unpack(q), _unpack(v), args)
            )
            return mj.MechanicalSystem(lambda q, args: args["masses"], phi, force, **options)

        def lagrangian(t, q, v, args):
            w = _unpack(v)
            return w @ args["masses"] @ w / 2 - family.potential(jnp, t, _unpack(q), args)

        friction = lambda t, q, v, args: _pack(
            layout, family.friction(jnp, t, _unpack(v), args)
        )
        return mj.MechanicalSystem.from_lagrangian(lagrangian, phi, friction, **options)


def _controller(structure: Structure, lane: Any) -> tuple[Any, Any]:
    span = lane["end"] - lane["start"]
    if structure.controller == "constant":
        return dfx.ConstantStepSize(), span / structure.steps
    if structure.controller == "step-to":
        grid = np.linspace(0.0, 1.0, structure.steps + 1)
        uneven = grid + 0.3 / structure.steps * np.sin(20 * grid) * grid * (1 - grid)
        inner = lane["start"] + span * jnp.asarray(uneven[1:-1])
        return dfx.StepTo(jnp.concatenate([lane["start"][None], inner, lane["end"][None]])), None
    options: dict[str, Any] = {"rtol": structure.tolerance, "atol": structure.tolerance}
    if structure.controller == "pi":
        options |= {"pcoeff": 0.3, "icoeff": 0.4}
    if structure.controller == "limited":
        options |= {"dtmax": jnp.abs(span) / 20, "factormax": 3.0}
    controller: Any = dfx.PIDController(**options)
    if structure.controller == "clipped":
        times = lane["start"] + span * jnp.asarray([0.3, 0.5])
        controller = dfx.ClipStepSizeController(controller, step_ts=times)
    if structure.jumps:
        storing = 10 if structure.controller == "jumps-storing" else None
        times = lane["args"]["jump_time"][None]
        controller = dfx.ClipStepSizeController(
            controller, jump_ts=times, store_rejected_steps=storing
        )
    return controller, span / 50 if structure.first_step else None


def _output(structure: Structure, lane: Any) -> tuple[dfx.SaveAt, Any, Callable]:
    """What to save, the event, and how to get times and states from the solution."""
    times = lane["start"] + (lane["end"] - lane["start"]) * jnp.asarray(FRACTIONS)
    rows = jax.vmap(_unpack)
    plain = lambda sol: (sol.ts, rows(sol.ys))
    with_time = lambda t, y, args: (t, y)
    inside = times[1:-1]
    if structure.output == "event":
        level = lambda t, y, args, **kwargs: level_function(jnp, _unpack(y)) - args["level"]
        event = dfx.Event(level, optx.Newton(rtol=1e-10, atol=1e-10))
        return dfx.SaveAt(t1=True), event, plain
    if structure.output == "dense":
        evaluated = lambda sol: (times, rows(jax.vmap(sol.evaluate)(times)))
        return dfx.SaveAt(dense=True), None, evaluated
    if structure.output == "fn":
        saved = lambda sol: (sol.ys[0], rows(sol.ys[1]))
        return dfx.SaveAt(ts=times, fn=with_time), None, saved
    if structure.output == "subs":
        early = dfx.SubSaveAt(t0=True, ts=inside[:2])
        late = dfx.SubSaveAt(ts=inside[2:], t1=True, fn=with_time)

        def both(sol):
            early, late = sol.ys["early"], sol.ys["late"]
            together = jnp.concatenate([sol.ts["early"], late[0]])
            return together, jnp.concatenate([rows(early), rows(late[1])])

        return dfx.SaveAt(subs={"early": early, "late": late}), None, both
    options = {
        "t1": dfx.SaveAt(t1=True),
        "ts": dfx.SaveAt(ts=times),
        "ends": dfx.SaveAt(t0=True, ts=inside, t1=True),
        "steps": dfx.SaveAt(t0=True, steps=True),
    }
    return options[structure.output], None, plain


def level_function(xp: Any, y: Any) -> Any:
    """What an event function compares with its level."""
    return xp.sum(y * np.cos(1 + np.arange(y.shape[-1])), axis=-1)
