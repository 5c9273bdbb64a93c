"""The front end: from equations to a vector field on a manifold."""

from collections.abc import Callable
from typing import Any, get_args, Literal, TypeAlias

import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.errors import listed
from .._base.numbers import with_arrays
from .._base.types import Args, Y
from .._linalg.singular_parts import SingularParts
from .analysis import Analysis
from .combined import without_cancellations
from .dependent_equations import DependentEquations
from .equations import Names, ResidualEquations
from .occurrence import Example, Occurrence
from .reduced import Reduced
from .report import DAEReport
from .system import ReducedDAE


Form: TypeAlias = Literal["ode", "index-1"]


def reduce_dae(
    F: Callable,
    x_example: Y,
    args_example: Args = None,
    *,
    order: int = 1,
    form: Form = "ode",
) -> ReducedDAE:
    r"""Reduce a differential-algebraic equation of any index,

    $$F(t, x, x', \dots, x^{(\mathrm{order})}, \mathrm{args}) = 0,$$

    written as ordinary JAX code, to a vector field on a manifold.

    ```python
    def pendulum(t, x, xdot, args):
        q, v, tension = x["q"], x["v"], x["tension"]
        force = -tension * q - jnp.array([0.0, 9.81])
        return xdot["q"] - v, xdot["v"] - force, q @ q - 1.0


    dae = mj.reduce_dae(pendulum, {"q": jnp.ones(2), "v": jnp.ones(2), "tension": 1.0})
    z0, _ = dae.consistent_state(0.0, {"q": ..., "v": ..., "tension": 0.0})
    sol = mj.diffeqsolve(dae.terms, mj.Projected(dfx.Tsit5(), dae.constraint), 0.0, 5.0, None, z0)
    x, xdot = dae.outputs(sol.ts, sol.ys)
    ```

    Structure alone decides which equation has to be differentiated how often (`c_i`) and up to
    which derivative unknowns then occur (`d_j`). The derivatives below `d_j` are the state, the
    equations and their derivatives below `c_i` its constraint, and `F_i^(c_i) = 0` are solved for
    the derivatives `d_j`: one linear system, whose matrix has first derivatives of `F` only.
    Equations like `x' - v = 0` drop out, so that the state of equations of first order consists
    of the user's own unknowns. An unknown like the voltage of a diode, of which an equation is a
    nonlinear function, becomes a state, too.

    **Arguments:**

    - `F`: `F(t, x, x', args)`, or with `x''` and `x'''` as `order` says. Returns any pytree of real
        arrays, as many numbers as `x` has, zero on solutions. It must be differentiable forwards
        (no `jax.custom_vjp`) as often as equations are differentiated.
    - `x_example`: a pytree of real floating-point arrays like `x`, with numbers at which `F` is
        defined. They need not be consistent.
    - `args_example`: parameters like those that will be used. Their values decide nothing but
        whether the reduced equations are nonsingular; arrays closed over by `F` are constants, whose
        zeros count as structure.
    - `order`: the highest derivative among the arguments of `F`, 1 to 3.
    - `form`: `"ode"` solves for the derivatives, for any solver. `"index-1"` leaves the equations for
        them to [`Rodas5P`][] or [`RadauIIA5`][], as unknowns of their own after the state: for stiff equations, and
        where they are nonlinear in their highest derivatives or multipliers (friction, diodes),
        which then need not become states. Derivatives of unknowns do not count in the error
        of a step where the equations are linear in them.

    **Returns:**

    A [`ReducedDAE`][], with the names `terms`, `constraint`, `consistent_state`, `outputs` and
    `report`. All its functions work under `jit`, `vmap` and both modes of differentiation.

    **Raises:**

    `ValueError` if there are not as many equations as unknowns, if the structure is singular (with
    the over- and underdetermined parts), if the reduced equations are singular though their
    structure is not, or under `jit`: structure is found before anything is compiled.
    `TypeError` for arguments of the wrong kind and for `jax.custom_vjp` in `F`.

    Structure cannot see what cancels. Where the highest derivatives cancel in a combination of
    equations with constant weights, as in circuits with loops of capacitors, `M x' = f(t, x)` with
    a constant singular matrix, the combination takes the place of one of them (`report.equations`
    says which). Their coefficients may vary if they are added and subtracted as one number, like
    the charge or the current between two nodes. Other cancellations are refused. For mechanisms
    [`MechanicalSystem`][] compiles to less and corrects positions and velocities in the metric of
    the masses.

    Source: J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001) 364-394.
    """
    if form not in get_args(Form):
        raise ValueError(f"`form` must be 'ode' or 'index-1', got {form!r}.")
    _check_concrete(x_example, args_example)
    args_example = with_arrays(args_example)  # as they will be used
    equations = ResidualEquations.of(F, x_example, args_example, order)
    x = jfu.ravel_pytree(jtu.tree_map(jnp.asarray, x_example))[0]
    example = Example.of(equations, x, args_example)
    occurrence = Occurrence.of(example)
    found = Analysis.of(example, occurrence, form == "index-1")
    if found is None:
        raise ValueError(_structurally_singular(equations.names, occurrence))
    found = without_cancellations(found)
    report = DAEReport.of(found)
    if found.samples.singular:
        raise ValueError(_singular(found, report))
    return ReducedDAE(Reduced(found.example.equations, found), report)


def _check_concrete(x: Any, args: Any) -> None:
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jtu.tree_leaves((x, args))):
        raise ValueError(
            "`reduce_dae` cannot be called under `jax.jit`, `jax.vmap` or `jax.grad`: structure is found before anything "
            "is compiled. Call it once outside, with numbers for `x_example` and `args_example`; what it returns "
            "takes traced `args`."
        )


def _structurally_singular(names: Names, occurrence: Occurrence) -> str:
    parts = SingularParts.of(occurrence.there.any(axis=1))  # pyright: ignore[reportArgumentType]
    named = lambda part: (
        listed([names.equations[i] for i in part[0]]),
        listed([names.unknowns[j] for j in part[1]]) or "none",
    )
    over, under = named(parts.overdetermined), named(parts.underdetermined)
    return (
        f"`F` is structurally singular. The equations {over[0]} are too many for the unknowns in them: {over[1]}. The "
        f"unknowns {under[1]} are left to too few equations: {under[0] or 'none'}. Replace an equation of the "
        "first part by one for the unknowns of the second."
    )


def _singular(found: Analysis, report: DAEReport) -> str:
    equations, vanishing = DependentEquations.of(found, found.samples.matrices[0])
    message = (
        f"`F` is structurally regular (index {report.index}, {report.degrees_of_freedom} degrees of freedom), but the "
        f"matrix of its leading derivatives is singular wherever it was evaluated (reciprocal condition "
        f"{max(found.samples.conditions):.0e} at best): "
    )
    if vanishing:
        return message + (
            f"the coefficients of {vanishing} in the equation {equations} are zero there. If a parameter in `args_example` is "
            "zero, give it as it will be used; if it stays zero, or if the terms cancel, write the equation without them."
        )
    return message + (
        f"the equations {equations} depend on each other there. Either they are "
        "redundant, or terms cancel that structure cannot see and the index is higher (a hidden index): combine "
        "those equations so that the cancelled derivatives are gone. For a problem of index 1 with a singular "
        "matrix, M x' = f(t, x), use `mj.MassMatrixTerm` with `mj.Rodas5P`."
    )
