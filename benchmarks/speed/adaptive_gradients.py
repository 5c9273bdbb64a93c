"""Gradients through adaptive steps in Diffrax by itself: which of its adjoints and solvers agree.

`python benchmarks/speed/adaptive_gradients.py`, with JAX and Diffrax alone, for a report to Diffrax.

`RecursiveCheckpointAdjoint` runs parts of a solve again to go back through them. XLA compiles that
second run with other fused operations than the first, so that it rounds differently. Where a decision
of the solver depends on rounding, the second run makes other steps than the first, and what comes out
is the derivative of no solution at all.

Such a decision is that of `VeryChord` for implicit stages: two iterates of the size of rounding of which
the second is larger are taken for divergence, and the step is rejected. KenCarp3, 4 and 5 come to such
iterates in most of their steps; Kvaerno4 and 5 take up to ten times the steps for that, but the same ones in
both runs here.

Printed: the derivative of a sum of saved values with respect to a factor in the field, relative
differences from forward mode, and the number of steps; the same with a Newton iteration of
another kind, which has no such decision.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx


jax.config.update("jax_enable_x64", True)
RANDOM = np.random.default_rng(3)
A, D = jnp.asarray(RANDOM.normal(size=(4, 4))), jnp.asarray(RANDOM.normal(size=4))
Q = jnp.array([1.0, 2.0, 0.5, 1.5])  # of the ellipsoid to which the field is tangent
START = jnp.array([1.0, 0.2, 0.3, 0.4])
MAX_STEPS = 16384
ADJOINTS = {
    "forward": dfx.ForwardMode(),
    "checkpointed": dfx.RecursiveCheckpointAdjoint(),
    "every state": dfx.RecursiveCheckpointAdjoint(checkpoints=MAX_STEPS),
}


def field(t, y, factor):
    f, normal = factor * A @ y + jnp.cos(t) * D, Q * y
    return f - normal * (normal @ f) / (normal @ normal)


def terms_for(solver):
    part = lambda share: dfx.ODETerm(lambda t, y, factor: share * field(t, y, factor))
    additive = isinstance(solver, dfx.KenCarp3 | dfx.KenCarp4 | dfx.KenCarp5 | dfx.Sil3)
    return dfx.MultiTerm(part(0.3), part(0.7)) if additive else part(1.0)


def objective(factor, solver, tolerance, adjoint):
    sol = dfx.diffeqsolve(
        terms_for(solver),
        solver,
        0.0,
        1.5,
        0.05,
        START / jnp.sqrt(START @ (Q * START)),
        factor,
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.5, 6)),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=adjoint,
        max_steps=MAX_STEPS,
        throw=False,
    )
    weights = jnp.cos(1.0 + jnp.arange(24.0)).reshape(6, 4)
    return jnp.sum(sol.ys * weights), sol.stats["num_steps"]


def row(solver, tolerance):
    found = {}
    for name, adjoint in ADJOINTS.items():
        transform = jax.jacfwd if name == "forward" else jax.grad
        gradient = jax.jit(
            transform(lambda f, a=adjoint: objective(f, solver, tolerance, a), has_aux=True)
        )
        try:
            found[name] = gradient(1.0)
        except RuntimeError:  # a stage that diverges has no derivative in forward mode
            found[name] = jnp.nan, 0
    forward, steps = found["forward"]
    differences = [float(abs(found[name][0] / forward - 1)) for name in list(ADJOINTS)[1:]]
    return forward, steps, differences


def main():
    newton = dfx.with_stepsize_controller_tols(optx.Newton)()
    print(f"jax {jax.__version__}, diffrax {dfx.__version__}")
    print(f"{'solver':27s}{'tolerance':>10s}{'steps':>7s}{'forward':>13s}", end="")
    print("".join(f"{name:>14s}" for name in list(ADJOINTS)[1:]))
    explicit = dfx.Tsit5(), dfx.Dopri5(), dfx.Dopri8()
    kinds = dfx.Kvaerno3, dfx.Kvaerno4, dfx.Kvaerno5, dfx.KenCarp3, dfx.KenCarp4, dfx.KenCarp5
    kinds = *kinds, dfx.Sil3
    for solver in (*explicit, *(k() for k in kinds), *(k(root_finder=newton) for k in kinds)):
        implicit = isinstance(solver, dfx.AbstractImplicitSolver)
        finder = f", {type(solver.root_finder).__name__}" if implicit else ""
        for tolerance in (1e-5, 1e-8):
            forward, steps, differences = row(solver, tolerance)
            print(f"{type(solver).__name__ + finder:27s}{tolerance:10.0e}{steps:7d}", end="")
            print(f"{forward:13.7f}", "".join(f"{d:14.1e}" for d in differences), flush=True)


if __name__ == "__main__":
    main()
