"""Terms, constraint and solver of one lane of a structure."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx

import manifold_jax as mj

from .structure import IMPLICIT, SPLIT, Structure


def _pack(layout: str, x: Any) -> Any:
    if layout == "scalars":
        return tuple(x[i] for i in range(x.size))
    if layout == "nested":
        return {"head": x[0], "rest": {"body": x[1:]}} if x.size > 1 else {"head": x[0]}
    if layout == "matrix":
        return x.reshape(-1, 2) if x.size % 2 == 0 else x[None]
    return {"all": x, "none": None} if layout == "with-none" else x


def unpack(tree: Any) -> Any:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jtu.tree_leaves(tree)])


def pack_state(structure: Structure, x: Any) -> Any:
    if not structure.family.mechanical:
        return _pack(structure.layout, x)
    q, v = jnp.split(x, 2)
    return _pack(structure.layout, q), _pack(structure.layout, v)


class Problem:
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
            return mj.NewtonProjection(metric=pack_state(self.structure, weights))
        return mj.NewtonProjection(max_steps=1) if name == "one-step" else None

    def _inner_solver(self) -> dfx.AbstractSolver:
        name = self.structure.solver
        if name == "HalfSolver":
            return dfx.HalfSolver(dfx.Heun())
        if name in IMPLICIT + SPLIT and not self.structure.is_adaptive:
            # Diffrax's `VeryChord` gives up at such tolerances, with plain solvers, too.
            root_finder = optx.Newton(rtol=1e-10, atol=1e-10)
            return getattr(dfx, name)(root_finder=root_finder, root_find_max_steps=30)
        return getattr(dfx, name)()

    def _constraint_and_terms(self) -> tuple[Any, Any]:
        if self.family.mechanical:
            system = self._system()
            return system.constraint, self._split(system.terms)
        pack = lambda x: _pack(self.structure.layout, x)
        constraint = self._constraint()
        if self.structure.own_field:
            raw = lambda t, y, args: pack(self.family.raw(jnp, t, unpack(y), args))
            field = mj.tangent_field(raw, constraint)
        else:
            field = lambda t, y, args: pack(self.family.field(jnp, t, unpack(y), args))
        return constraint, self._split(dfx.ODETerm(field))

    def _split(self, terms: Any) -> Any:
        if self.structure.solver not in SPLIT:
            return terms
        unit = jnp.ones(())
        part = lambda c: (
            lambda t, y, args: jtu.tree_map(lambda f: c * f, terms.vf_prod(t, y, args, unit))
        )
        return dfx.MultiTerm(dfx.ODETerm(part(0.3)), dfx.ODETerm(part(0.7)))

    def _constraint(self) -> Any:
        family, lane = self.family, self.lane
        if family.conserves:
            function = lambda t, y, args: self._arranged(family.invariants(jnp, unpack(y), args))
            y0 = pack_state(self.structure, lane["y0"])
            return mj.Invariants(function, y0=y0, t0=lane["start"], args=lane["args"])
        return mj.Constraint(
            lambda t, y, args: self._arranged(
                self._spoilt(t, family.residual(jnp, t, unpack(y), args), args)
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
            phi = self._spoilt(t, family.position(jnp, t, unpack(q), args), args)
            return self._arranged(jnp.append(phi, phi[:1]) if options["redundant"] else phi)

        def rolling(t, q, v, args):
            a = family.rolling(jnp, t, unpack(q), unpack(v), args)
            return a if holonomic is not None else self._spoilt(t, a, args)

        if family.rolls:
            options["velocity_constraint"] = rolling
        phi = None if holonomic is None else position
        if family.mass != "lagrangian":
            force = lambda t, q, v, args: _pack(
                layout, family.force(jnp, t, unpack(q), unpack(v), args)
            )
            return mj.MechanicalSystem(lambda q, args: args["masses"], phi, force, **options)

        def lagrangian(t, q, v, args):
            w = unpack(v)
            return w @ args["masses"] @ w / 2 - family.potential(jnp, t, unpack(q), args)

        friction = lambda t, q, v, args: _pack(layout, family.friction(jnp, t, unpack(v), args))
        return mj.MechanicalSystem.from_lagrangian(lagrangian, phi, friction, **options)
