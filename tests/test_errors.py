"""What is shown of an error: the library's own message comes first, for logs, and last, or nearly, for
terminals."""

import os
import subprocess
import sys
from pathlib import Path

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import manifold_jax as mj


NOWHERE = mj.Constraint(lambda t, y, args: y @ y + 1.0)
START = jnp.array([1.0, 0.0])
MESSAGE = "check that the equations can hold at the same time."


SLOPE = mj.MechanicalSystem(
    1.0, lambda t, q, args: q[0] - q[1], lambda t, q, v, args: jnp.array([0.0, -9.81])
)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mj.consistent_state(NOWHERE, 0.0, START), MESSAGE),
        (lambda: mj.project(NOWHERE, 0.0, START), MESSAGE),
        (lambda: mj.equilibrium(SLOPE, START), "cannot be found."),
    ],
    ids=["consistent_state", "project", "equilibrium"],
)
def test_the_message_is_the_beginning_and_the_end(call, message):
    with pytest.raises(RuntimeError) as error:
        call()
    first, *_, last = str(error.value).splitlines()
    assert first == last
    assert first.endswith(message)
    assert "EQX_ON_ERROR" not in str(error.value)


def test_errors_of_users_keep_the_place_where_they_occurred():
    def residual(t, y, args):
        return y @ y - eqx.error_if(args, args < 0, "no negative radius, please")

    message = "no negative radius, please"
    with pytest.raises(RuntimeError, match=f"(?s)^{message}.*in residual.*{message}$"):
        mj.project(mj.Constraint(residual), 0.0, START, jnp.asarray(-1.0))


def test_forward_mode_through_the_default_adjoint_of_ensembles():
    def end(y0):
        terms = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
        circle = mj.Constraint(lambda t, y, args: y @ y - 1.0)
        hook = mj.Projected(dfx.Tsit5(), circle)
        return mj.solve_ensemble(terms, hook, 0.0, 0.1, 0.1, y0[None]).ys

    for transform in (jax.jacfwd, lambda f: jax.jit(jax.jacfwd(f))):
        with pytest.raises(TypeError, match=r"adjoint=diffrax.ForwardMode\(\)"):
            transform(end)(START)


PROGRAM = """
import jax.numpy as jnp
import diffrax as dfx, manifold_jax as mj

constraint = mj.Constraint(lambda t, y, args: y @ y + 1.0)
terms = dfx.ODETerm(lambda t, y, args: jnp.stack([-y[1], y[0]]))
y0 = {y0}
mj.diffeqsolve(terms, mj.Projected(dfx.Heun(), constraint), 0.0, 1.0, 0.1, y0)
"""


@pytest.mark.parametrize(
    ("y0", "message"),
    [("jnp.array([1.0, 0.0])", MESSAGE), ("jnp.array([1, 0])", "jnp.asarray(leaf, float), y0)`.")],
)
def test_a_script(y0, message):
    """While running, and while tracing, where JAX adds a note of two lines."""
    root = Path(mj.__file__).parents[1]
    process = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(y0=y0)],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 1
    assert any(line.endswith(message) for line in process.stderr.splitlines()[-3:])
