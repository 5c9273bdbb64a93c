"""What one accepted step of each approach should cost, to compare counts with.

What Sudarsan & Keerthi, Appl. Math. Comput. 92 (1998) 153-193, do in section 4, derived from
the algorithms: the text that was available does not have their formulas.
"""

from typing import NamedTuple

import diffrax as dfx


# Newton iterations of a correction at the end of a step, where the point is near the manifold,
# and of one in a chart, where the displacement is that of a whole step (both are typical).
NEAR, FAR = 2, 4


class Cost(NamedTuple):
    """Evaluations per step of the vector field, of the residual and of its Jacobian, and the
    floating-point operations of the linear algebra around them."""

    f: float
    g: float
    G: float
    flops: float


def stages_per_step(solver: dfx.AbstractSolver) -> int:
    """Of an explicit Runge-Kutta method; the last one is free if the next step starts with it."""
    assert isinstance(solver, dfx.AbstractERK)
    tableau = solver.tableau
    assert isinstance(tableau, dfx.ButcherTableau)
    return tableau.num_stages - (1 if tableau.fsal and tableau.ssal else 0)


def predicted_cost(approach: str, s: int, n: int, m: int) -> Cost | None:
    """`s` stages, `n` numbers in the state, `m` constraints (of mechanics: both halves). None for
    approaches whose costs depend on the problem (charts of its own) or are not known here.

    In charts every lift has a Jacobian of its own, besides that of the chart.
    """
    factor = m * m * n + m**3 / 3
    solve = 2 * m * m + 2 * m * n
    lifts = s + 1
    lift = factor + FAR * solve
    chart = Cost(
        s, lifts * (FAR + 1), lifts + 1, factor + lifts * lift + s * (4 * m * n + 2 * m * m)
    )
    costs = {
        "plain": Cost(s, 0, 0, 0),
        "projected": Cost(s, NEAR + 1, 1, factor + NEAR * solve),
        "one-step": Cost(s, 1, 1, factor + solve),
        "invariant": Cost(s, s, s, s * (factor + solve)),
        "exact": Cost(s, s * (NEAR + 1), s, s * (factor + NEAR * solve)),
        "baumgarte": Cost(s, 0, 0, 0),
        "tangent": chart,
        "partition": chart,
    }
    return costs.get(approach)
