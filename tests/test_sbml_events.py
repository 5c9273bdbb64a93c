"""Cases with events of the SBML semantic test suite, against the published results."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest


sys.path.append(str(Path(__file__).parents[1]))

from benchmarks.sbml_events.__main__ import difference_of_modes
from benchmarks.sbml_events.cases import build, excess, read


CASES = read()
# Two events in turn, one that is not met at the start, a volume that jumps.
QUICK = ("00041", "00929", "01505")
ALGEBRAIC = "00760"


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(number, marks=() if number in QUICK else pytest.mark.slow)
        for number in sorted({*QUICK, ALGEBRAIC, *sorted(CASES)[3::16]})
    ],
)
def test_published_results(number):
    """Within the tolerance of the suite; every sixteenth case and those above. All of them, with their
    gradients: `python -m benchmarks.sbml_events --gradients`."""
    case = CASES[number]
    problem, ts = build(case), jnp.asarray(case["times"])
    sol = jax.jit(lambda y0, args: problem.solve(y0, args, ts))(problem.y0, problem.args)
    assert excess(case, np.asarray(sol.ys)) <= 1
    if number in (*QUICK, ALGEBRAIC):
        difference = difference_of_modes(problem, ts, sol.ys)
        assert difference is None or difference < 1e-11
