"""Drawings of mechanisms: where the constraint holds, bodies meet and have their lengths."""

from types import SimpleNamespace

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import manifold_jax as mj
from manifold_jax._tools.animate import DrawnMotion, SKETCHES
from manifold_jax._tools.cli import app


def lines_of(name, moved=0.0):
    problem = (mj.problems.ALL | mj.problems.FURTHER)[name]()
    q = jtu.tree_map(lambda x: np.asarray(x)[None] + moved, problem.y0[0])
    motion = DrawnMotion(np.zeros(1), q, problem.args)
    return [line[0] for line in SKETCHES[name](motion)], problem.args


def lengths(line):
    return np.linalg.norm(np.diff(line, axis=0), axis=1)


@pytest.mark.parametrize("name", ["pendulum", "double-pendulum", "chain"])
def test_chains_hang_from_the_origin(name):
    (line,), args = lines_of(name)
    np.testing.assert_array_equal(line[0], 0)
    expected = args.lengths if hasattr(args, "lengths") else [args.length]
    np.testing.assert_allclose(lengths(line), expected, rtol=1e-12)


def test_four_bar_is_closed_where_the_constraint_holds():
    bodies, args = lines_of("four-bar")
    ends = np.array([[body[0], body[-1]] for body in bodies])
    pivots = [[0, 0], [args.lengths[3], 0]]
    np.testing.assert_allclose([ends[0, 0], ends[2, 0]], pivots, atol=1e-12)
    np.testing.assert_allclose([ends[0, 1], ends[1, 1]], [ends[1, 0], ends[2, 1]], atol=1e-12)
    np.testing.assert_allclose([lengths(body)[0] for body in bodies], args.lengths[:3])
    apart, _ = lines_of("four-bar", np.arange(9) * 0.1)
    assert np.linalg.norm(apart[0][-1] - apart[1][0]) > 0.1


def test_slider_crank_and_parallelogram_are_closed_where_the_constraint_holds():
    (crank, rod), args = lines_of("slider-crank")
    np.testing.assert_allclose(crank[-1], rod[0], atol=1e-12)
    np.testing.assert_allclose([lengths(crank)[0], lengths(rod)[0]], [args.crank_length, 1])
    (coupler, *cranks), _ = lines_of("parallelogram")
    np.testing.assert_allclose(coupler, [crank[-1] for crank in cranks], atol=1e-12)


def test_robots_are_closed_where_the_constraint_holds():
    lines, _ = lines_of("stewart-platform")
    base, platform, *legs = lines
    np.testing.assert_allclose([leg[0] for leg in legs[0::2]], base[:6], atol=1e-12)
    np.testing.assert_allclose([leg[0] for leg in legs[1::2]], platform[:6], atol=1e-12)
    lines, _ = lines_of("delta-robot")
    for arm, elbows, *rods in (lines[i : i + 4] for i in range(0, 12, 4)):
        np.testing.assert_allclose(arm[1], elbows.mean(axis=0), atol=1e-12)
        assert all(np.min(np.linalg.norm(lines[12] - rod[1], axis=1)) < 1e-12 for rod in rods)
        # Parallel rods of the same length are so in every view.
        np.testing.assert_allclose(*[rod[1] - rod[0] for rod in rods], atol=1e-12)


def test_the_bead_is_on_the_hoop():
    (hoop, stop, bead), args = lines_of("rotating-hoop")
    at = lambda angle: (
        np.cos(angle) * hoop[0] + np.sin(angle) * hoop[8]
    )  # an ellipse by its conjugate radii
    np.testing.assert_allclose(hoop, [at(a) for a in np.linspace(0, 2 * np.pi, 33)], atol=1e-12)
    np.testing.assert_allclose(bead[:-1].mean(axis=0), at(0.4), atol=1e-12)
    np.testing.assert_allclose(stop.mean(axis=0), at(float(args.stop)), atol=1e-12)


def test_the_hip_of_a_walker_does_not_jump():
    problem = mj.problems.compass_gait()
    before = problem.reference(3.88)
    after = problem.resets[0].jump(3.88, jtu.tree_map(jnp.asarray, before), problem.args)
    resets = SimpleNamespace(
        number=1,
        times=np.array([3.88, np.inf]),
        before=[np.stack([before[0]] * 2)],
        after=[np.stack([after[0]] * 2)],
    )
    times, q = np.array([3.87, 3.88]), np.stack([before[0], after[0]])
    _, stance, swing = SKETCHES["compass-gait"](DrawnMotion(times, q, problem.args, resets))
    np.testing.assert_allclose(stance[0], swing[1], atol=1e-12)
    np.testing.assert_allclose(swing[0], stance[1], atol=1e-12)


def test_all_mechanisms_have_a_drawing_and_others_are_refused():
    for name in SKETCHES:
        assert jtu.tree_leaves(lines_of(name)[0])
    outcome = CliRunner().invoke(app, ["animate", "kepler", "--out", "film.gif"])
    assert outcome.exit_code == 2
    assert "four-bar" in outcome.output


@pytest.mark.slow
def test_film(tmp_path):
    out = tmp_path / "film.gif"
    command = ["animate", "pendulum", "--out", str(out), "--t1", "20", "--seconds", "0.2"]
    outcome = CliRunner().invoke(app, command)
    assert outcome.exit_code == 0, outcome.output
    plain, projected = (
        float(line.split("=")[1]) for line in outcome.output.splitlines() if "max |g|" in line
    )
    assert projected < 1e-14 < 1e-3 < plain
    with Image.open(out) as film:
        assert (film.n_frames, film.info["duration"]) == (4, 50)
        panels = np.asarray(film.convert("RGB"), int)
    left, right = np.split(panels, 2, axis=1)
    assert (left[..., 0] > left[..., 2] + 100).any()  # red
    assert (right[..., 2] > right[..., 0] + 100).any()  # blue
