"""Structure: what depends on what, and how often equations have to be differentiated."""

import dae_models as models
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from manifold_jax._dae.equations import ResidualEquations
from manifold_jax._dae.occurrence import Example, nonlinear_unknowns, Occurrence
from manifold_jax._dae.signature import ABSENT, DAEStructure, signature
from manifold_jax._jaxpr.incidence import incidence
from manifold_jax._linalg.coloring import greedy_colors
from manifold_jax._linalg.singular_parts import SingularParts


def depends(function, n=6):
    return incidence(function, (jnp.zeros(n), np.eye(n, dtype=bool)))


CONSTANT = jnp.asarray(np.diag([1.0, 0.0, 2.0]))
EXACT = {
    "constant matrix": lambda x: CONSTANT @ x[:3],
    "assembled": lambda x: jnp.zeros(4).at[jnp.array([1, 1, 2])].add(x[:3]),
    "replaced": lambda x: x.at[2:4].set(x[:2]),
    "picked": lambda x: x[jnp.array([3, 1])] * x[0],
    "from nowhere": lambda x: x.at[jnp.array([9, 1])].get(mode="fill", fill_value=0.0),
    "loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, c: c.at[i + 1].add(x[i]), jnp.zeros(6)),
    "scan": lambda x: jax.lax.scan(lambda c, a: (c + a, c * a), 0.0, x[::-1], reverse=True)[1],
    "einsum": lambda x: jnp.einsum("ij,j->i", x.reshape(2, 3), jnp.array([1.0, 0, 1])),
    "batched": lambda x: jax.vmap(lambda a, b: a @ b)(x.reshape(2, 3), x[::-1].reshape(2, 3)),
    "gradient": lambda x: jax.grad(lambda x: jnp.sum(x[:3] ** 2 * x[3:]))(x),
    "cumulated": jnp.cumsum,
    "columns first": lambda x: x.reshape(2, 3).ravel(order="F"),
    "divided": lambda x: x[:3] / x[3:],
    "rolled": lambda x: jnp.roll(x, 1) / 2,
    "padded": lambda x: jnp.pad(x[:2], (1, 2)) - jnp.tile(x[2:3], 5),
    "crossed": lambda x: jnp.cross(x[:3], x[3:]),
    "norms": lambda x: jnp.linalg.norm(x.reshape(3, 2), axis=1),
    "times zero": lambda x: x * jnp.zeros(6).at[1].set(x[2]),
    "checkpointed": jax.checkpoint(lambda x: jnp.sin(x[:2]) + jnp.max(x[2:4])),
    "known branch": lambda x: jax.lax.cond(True, lambda x: x[1:], lambda x: x[:-1], x),
}
SAFE = {
    "solve": lambda x: jnp.linalg.solve(jnp.eye(2) + x[0] * jnp.ones((2, 2)), x[2:4]),
    "branches": lambda x: jax.lax.cond(x[0] > 0, lambda x: x[1:], lambda x: x[:-1], x),
    "table": lambda x: jnp.interp(x, jnp.arange(3.0), jnp.arange(3.0) ** 2),
    "relu": jax.nn.relu,
    "convolution": lambda x: jnp.convolve(x, jnp.ones(2)),
    "sorted": jnp.sort,
    "picked by value": lambda x: x[jnp.argmax(x[:3])][None],
    "long scan": lambda x: jax.lax.scan(
        lambda c, i: (jnp.tanh(c + x[1:3]), c[0]), x[:2], None, 2000
    )[0],
    "while": lambda x: jax.lax.while_loop(
        lambda c: c[0] < x[5], lambda c: c + 1 + x[1] ** 2, x[2:4]
    ),
}


def numeric(function):
    random = np.random.default_rng(0)
    points = jnp.asarray(random.uniform(0.2, 2.0, (3, 6)))
    slopes = jax.jit(jax.vmap(jax.jacfwd(function)))(points)
    return np.any(np.asarray(slopes) != 0, axis=0)


@pytest.mark.parametrize("function", EXACT.values(), ids=EXACT)
def test_what_depends_on_what(function):
    found = depends(function)
    np.testing.assert_array_equal(found.depends, numeric(function))
    assert not found.unknown_primitives


@pytest.mark.parametrize("function", SAFE.values(), ids=SAFE)
def test_no_dependency_is_missed(function):
    assert not (numeric(function) & ~depends(function).depends).any()


def test_what_no_point_shows():
    """Branches that are not taken, and the numbers that decide between them."""
    found = depends(lambda x: jnp.where(x[:1] > 50, x[1:2], x[2:3]))
    assert found.depends.tolist() == [[True, True, True, False, False, False]]
    counted = depends(
        lambda x: jax.lax.while_loop(lambda c: c[0] < x[5], lambda c: c + 1 + x[1], x[2:4])
    )
    assert counted.depends.tolist() == [
        [k in (1, 2, 5) for k in range(6)],
        [k in (1, 2, 3, 5) for k in range(6)],
    ]


def test_unknown_primitives_are_reported():
    found = depends(jnp.sort)
    assert found.unknown_primitives == {"sort": 1}
    assert found.depends.all()


def test_asdex_agrees():
    asdex = pytest.importorskip("asdex")
    for name in ("constant matrix", "replaced", "scan", "einsum", "cumulated", "crossed", "norms"):
        theirs = np.asarray(asdex.jacobian_sparsity(EXACT[name], jnp.zeros(6)).todense())
        assert not (depends(EXACT[name]).depends & (theirs == 0)).any(), name


# Signature matrices


def analyzed(model, x, args, order=1):
    equations = ResidualEquations.of(model, x, args, order)
    example = Example.of(equations, jax.flatten_util.ravel_pytree(x)[0], args)
    return example, Occurrence.of(example)


CASES = {
    "pendulum": (models.pendulum, jnp.ones(5), models.PENDULUM_ARGS, 1, 3, 2),
    "pendulum, second order": (
        models.pendulum_second_order,
        {"q": jnp.ones(2), "tension": jnp.asarray(1.0)},
        *(models.PENDULUM_ARGS, 2, 3, 2),
    ),
    "two links": (models.chain, *models.chain_example(2), 1, 3, 4),
    "RLC": (models.rlc_series, jnp.ones(4), models.RLC_ARGS, 1, 1, 2),
    "capacitor loop": (models.capacitor_loop, jnp.ones(4), models.RLC_ARGS, 1, 2, 1),
    "diode": (models.diode, jnp.ones(3), models.DIODE_ARGS, 1, 1, 1),
    "transistor": (models.transistor, jnp.ones(8), None, 1, 0, 8),
    "Robertson": (models.robertson, jnp.ones(3), jnp.ones(3), 1, 1, 2),
    "Akzo Nobel": (models.akzo_nobel, jnp.ones(6), None, 1, 1, 5),
    "crane": (models.crane, jnp.ones(12), models.CRANE_ARGS, 1, 5, 0),
}


def pantelides(sigma):
    """How often each equation is differentiated, by Pantelides' algorithm (SIAM J. Sci. Stat.
    Comput. 9 (1988) 213-231); `None` if the structure is singular."""
    n = len(sigma)
    there = sigma != ABSENT
    highest = np.where(there, sigma, -1).max(axis=0)
    times = np.zeros(n, int)

    def assigned_after(equation, neighbours, assigned, seen_equations, seen_unknowns):
        seen_equations.add(equation)
        for j in neighbours(equation):
            if j not in seen_unknowns:
                seen_unknowns.add(j)
                if assigned[j] < 0 or assigned_after(
                    assigned[j], neighbours, assigned, seen_equations, seen_unknowns
                ):
                    assigned[j] = equation
                    return True
        return False

    everywhere = lambda i: np.nonzero(there[i])[0]
    matched = np.full(n, -1)
    if not all(assigned_after(i, everywhere, matched, set(), set()) for i in range(n)):
        return None
    leading = lambda i: np.nonzero(there[i] & (sigma[i] + times[i] == highest))[0]
    assigned = np.full(n, -1)
    for i in range(n):
        while True:
            equations, unknowns = set(), set()
            if assigned_after(i, leading, assigned, equations, unknowns):
                break
            highest[list(unknowns)] += 1
            times[list(equations)] += 1
    return times


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_offsets_of_models(case):
    *model, index, freedom = case
    _, occurrence = analyzed(*model)
    structure = DAEStructure.of(signature(occurrence.there))
    assert (structure.index, structure.degrees_of_freedom) == (index, freedom)
    np.testing.assert_array_equal(structure.c, pantelides(structure.sigma))
    np.testing.assert_array_equal(structure.leading.any(axis=0), True)


def test_offsets_of_random_matrices():
    random, singular = np.random.default_rng(1), 0
    for _ in range(1000):
        n = random.integers(2, 7)
        sigma = random.integers(0, 4, (n, n))
        sigma = np.where(random.uniform(size=(n, n)) < 0.55, ABSENT, sigma)
        expected, structure = pantelides(sigma), DAEStructure.of(sigma)
        singular += expected is None
        assert (structure is None) == (expected is None)
        if structure is not None:
            np.testing.assert_array_equal(structure.c, expected)
            slack = structure.d[None, :] - structure.c[:, None] - sigma
            assert (slack >= 0).all()
            assert (slack[np.arange(n), structure.transversal] == 0).all()
    assert 100 < singular < 900


def test_parts_of_a_singular_structure():
    """Equations 0 and 1 for unknown 0, equation 3 for the unknowns 2 and 3."""
    there = np.array([[1, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0], [0, 1, 1, 1]], bool)
    parts = SingularParts.of(there)
    assert [list(part) for part in parts.overdetermined] == [[0, 1], [0]]
    assert [list(part) for part in parts.underdetermined] == [[3], [2, 3]]


# Coefficients


def test_constant_coefficients():
    _, occurrence = analyzed(CASES["pendulum"][0], *CASES["pendulum"][1:4])
    # of x' and v in x' - v, of v' in the equations of motion; not those of a circle
    constant = occurrence.there & ~occurrence.varies
    assert [row.nonzero()[0].tolist() for row in constant[:, 1]] == [[0], [1], [2], [3], []]
    assert constant[:, 0].sum(axis=1).tolist() == [1, 1, 0, 0, 0]
    assert occurrence.depends_on_args.tolist() == [False, False, True, True, True]
    assert occurrence.coefficients_vary.tolist() == [False, False, True, True, True]
    assert not occurrence.depends_on_time.any()


def test_coefficients_that_depend_on_time_vary():
    model = lambda t, x, xdot, a: jnp.stack([jnp.cos(t) * xdot[0] - x[1], x[0] - t])
    _, occurrence = analyzed(model, jnp.ones(2), None)
    assert occurrence.varies[0, 1, 0]
    assert not occurrence.varies[0, 0, 1]
    assert occurrence.depends_on_time.tolist() == [True, True]


def test_what_is_nonlinear_in_the_leading_derivatives():
    """A product of one with a state is linear, of two is not."""
    model = lambda t, x, xdot, a: jnp.stack(
        [xdot[0] * x[1] + x[2], jnp.sin(x[1]) + xdot[2] ** 2, x[2] * x[1]]
    )
    example, _ = analyzed(model, jnp.ones(3), None)
    levels, unknowns = np.array([1, 1, 1, 0]), np.array([0, 1, 2, 1])
    found = nonlinear_unknowns(example, levels, unknowns)
    assert found.tolist() == [
        [True, False, False, True],
        [False, False, True, True],
        [False, False, False, False],
    ]


def test_colors_never_conflict():
    conflict = np.random.default_rng(0).uniform(size=(30, 30)) < 0.1
    colors = greedy_colors(conflict, most_conflicts_first=True)
    np.fill_diagonal(conflict, False)
    assert not (conflict & (colors[:, None] == colors[None, :])).any()
    assert colors.max() < 12
