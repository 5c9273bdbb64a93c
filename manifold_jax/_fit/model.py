"""Initial value problems and predicted measurements as functions of the parameters."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._base.compat import is_okay
from .._base.types import Args, BoolScalar, FloatScalar, IntScalar, Y
from .._constraint.checks import check_state
from .._constraint.constraint import AbstractConstraint, Constraint, Invariants
from .._mechanics import MechanicalSystem
from .._resets.reset import Reset, ResetAt
from .._solve import diffeqsolve
from .._solver import Projected
from .._solver.base import AbstractManifoldSolver
from .parameters import Transform


class Setting(NamedTuple):
    """The arguments of one solve, apart from times."""

    terms: Any
    constraint: AbstractConstraint
    y0: Y
    args: Args


class Piece(NamedTuple):
    """One stretch of one record, solved separately, with `L` times, the last of which is where the next
    stretch of that record begins. Fields have a leading axis, one entry a piece."""

    start: FloatScalar
    ts: Float[Array, " L"]
    data: Float[Array, "L k"]
    weights: Float[Array, "L k"]
    guess: Float[Array, " n"]  # the state at `start`, unless it is that of the record
    basis: Float[Array, "n d"]  # of the tangent space there
    first: BoolScalar
    record: IntScalar


class Prediction(NamedTuple):
    """The prediction for one piece; zeros, without derivative, if the solve failed."""

    observed: Float[Array, "L k"]
    begin: Float[Array, " n"]
    end: Float[Array, " n"]
    failed: Float[Array, ""]


class Simulator(eqx.Module):
    """The user's model with all arguments that are not fitted."""

    model: Any
    transform: Transform
    y0: Any
    observe: Callable | None
    solver: Callable  # maps the constraint, which depends on the parameters, to a solver
    controller: dfx.AbstractStepSizeController
    dt0: Any
    resets: tuple[Reset | ResetAt, ...]
    max_steps: int | None = eqx.field(static=True)
    max_resets: int = eqx.field(static=True)
    many: bool = eqx.field(static=True)

    def setting(self, parameters: Any, record: Any) -> Setting:
        """Return the initial value problem of one record."""
        built = _build(self.model, parameters)
        y0 = self.y0(parameters) if callable(self.y0) else self.y0
        if y0 is None:
            if not hasattr(built, "y0"):
                raise ValueError(
                    "`y0` is missing: pass the initial state, a function `y0(parameters)`, or a "
                    "guess of it with `fit_initial=True`. Only a gallery problem brings its own."
                )
            y0 = built.y0
        elif self.many:
            y0 = jtu.tree_map(lambda leaf: jnp.asarray(leaf)[record], y0)
        check_state(y0, "y0")
        y0 = jtu.tree_map(lambda leaf: jnp.asarray(leaf, float), y0)
        if isinstance(built, tuple):
            return Setting(*built, y0, parameters)  # pyright: ignore[reportCallIssue]
        args = parameters if isinstance(built, MechanicalSystem) else built.args
        return Setting(built.terms, built.constraint, y0, args)

    def given(self, record: Any = 0) -> Setting:
        """Return that problem with the start values of the parameters."""
        return self.setting(self.transform.unravel(self.transform.start), record)

    def observation(self, t: Any, y: Y, parameters: Any) -> Any:
        return y if self.observe is None else self.observe(t, y, parameters)

    def beginning(self, x: Float[Array, " q"], piece: Piece) -> Setting:
        """Return the initial value problem of one piece; `x` as for `predict`."""
        setting = self.setting(self.transform.parameters(x), piece.record)
        base, unravel = jfu.ravel_pytree(setting.y0)
        y0 = unravel(
            jnp.where(piece.first, base, piece.guess) + piece.basis @ x[self.transform.start.size :]
        )
        constraint = at_start(setting.constraint, piece.start, y0, setting.args)
        return setting._replace(y0=y0, constraint=constraint)

    def predict(self, x: Float[Array, " q"], piece: Piece, adjoint: Any) -> Prediction:
        """Predict the measurements of one piece; `x` are the unknowns of the parameters, then tangent
        coordinates of the initial state."""
        setting = self.beginning(x, piece)
        parameters = self.transform.parameters(x)
        sol = diffeqsolve(
            setting.terms,
            self.solver(setting.constraint),
            piece.start,
            piece.ts[-1],
            self.dt0,
            setting.y0,
            setting.args,
            saveat=dfx.SaveAt(ts=piece.ts),
            stepsize_controller=self.controller,
            adjoint=adjoint,
            max_steps=self.max_steps,
            resets=self.resets,
            max_resets=self.max_resets,
            throw=False,
        )
        states = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(sol.ys)
        observe = lambda t, y: jfu.ravel_pytree(self.observation(t, y, parameters))[0]
        observed = jax.vmap(observe)(piece.ts, sol.ys)
        finite = jnp.all(jnp.isfinite(states)) & jnp.all(jnp.isfinite(observed))
        failed = ~(is_okay(sol.result) & finite)
        keep = lambda values: jnp.where(failed, 0, values)
        kept = keep(observed), keep(states[0]), keep(states[-1])
        return Prediction(*kept, failed.astype(observed.dtype))


def at_start(constraint: AbstractConstraint, t: Any, y: Y, args: Args) -> AbstractConstraint:
    """Freeze conserved quantities at the state that the solve starts from."""
    if isinstance(constraint, Invariants):
        return Invariants(constraint.function, y0=y, t0=t, args=args)
    return constraint


def _no_equations(t: Any, y: Y, args: Args) -> Array:
    return jnp.zeros(0)


_NO_EQUATIONS = Constraint(_no_equations)  # of an equation on the whole space


def _build(model: Any, parameters: Any) -> Any:
    """Return a gallery problem or a mechanical system with these parameters, or `(terms, constraint)`."""
    if hasattr(model, "with_args"):
        return model.with_args(_args_of(model, parameters))
    if isinstance(model, MechanicalSystem):
        return model
    if isinstance(model, dfx.AbstractTerm):
        return model, _NO_EQUATIONS
    if not callable(model):
        raise TypeError(
            "`model` must be a problem of the gallery, an `mj.MechanicalSystem`, a term of Diffrax, or a function of "
            f"the parameters that returns one or `(terms, constraint)`, got {type(model).__name__}."
        )
    built = model(parameters)
    pair = isinstance(built, tuple) and len(built) == 2
    if pair and isinstance(built[1], AbstractConstraint):  # pyright: ignore[reportIndexIssue]
        return built
    if isinstance(built, MechanicalSystem) or hasattr(built, "with_args"):
        return built
    if isinstance(built, dfx.AbstractTerm):
        return built, _NO_EQUATIONS
    raise TypeError(
        "`model(parameters)` must return a problem of the gallery, an `mj.MechanicalSystem`, `(terms, constraint)` "
        f"or a term of Diffrax, got {type(built).__name__}."
    )


def _args_of(problem: Any, parameters: Any) -> Args:
    """Return the arguments of a gallery problem, some of them replaced."""
    if isinstance(parameters, type(problem.args)):
        return parameters
    fields = getattr(problem.args, "_fields", ())
    if not isinstance(parameters, dict) or not set(parameters) <= set(fields):
        raise ValueError(
            f"`parameters` of `{problem.name}` must be a dictionary with some of the keys "
            f"{list(fields)}. For others write `model=lambda parameters: problem.with_args(...)`."
        )
    for name, value in parameters.items():
        if jnp.shape(value) != jnp.shape(getattr(problem.args, name)):
            raise ValueError(
                f"`parameters`: {name} must have shape {jnp.shape(getattr(problem.args, name))}, "
                f"got {jnp.shape(value)}."
            )
    return problem.args._replace(**parameters)


def as_function_of_constraint(solver: Any) -> Callable:
    if isinstance(solver, AbstractManifoldSolver):
        raise TypeError(
            "`solver` must not hold a constraint, as that depends on the parameters: pass the "
            "Diffrax solver inside (it is wrapped in `mj.Projected`), or "
            "`solver=lambda constraint: mj.LocalCoordinates(dfx.Tsit5(), constraint)`."
        )
    if isinstance(solver, dfx.AbstractSolver):
        return eqx.Partial(Projected, solver)
    if not callable(solver):
        raise TypeError(
            "`solver` must be a Diffrax solver or a function of the constraint that returns a "
            f"solver, got {type(solver).__name__}."
        )
    return solver
