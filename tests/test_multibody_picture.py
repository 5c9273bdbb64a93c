"""Pictures of assemblies: bodies meet where joints hold, and markers are where they are drawn."""

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.figure
import multibody_cases as cases
import numpy as np
import pytest
from PIL import Image

import manifold_jax as mj
from manifold_jax._multibody.picture import outline_of
from manifold_jax.problems.delta_robot import assembly as delta_robot


mpl.use("Agg")
mb = mj.multibody


@pytest.fixture(scope="module")
def crank():
    """A slider-crank at three angles of the crank, and at 0.3 in its drawing."""
    robot = cases.slider_crank(mj.problems.slider_crank().args)
    states = [robot.state(None, {"crank": angle}, assemble=True) for angle in (0.3, 0.5, 0.7)]
    return robot, jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def test_bodies_meet_at_joints(crank):
    robot, states = crank
    outline = outline_of(robot, states, None)
    assert len(outline.bodies) == len(robot.names)
    lines = dict(zip(robot.names, outline.bodies, strict=True))
    apart = lambda a, b: np.min(np.linalg.norm(a[:, :, None] - b[:, None], axis=-1), axis=(1, 2))
    assert np.all(apart(lines["crank"], lines["rod"]) < 1e-12)
    assert np.all(
        apart(lines["crank"], np.broadcast_to(outline.ground, (3, *outline.ground.shape))) < 1e-12
    )
    # Where the joints do not hold they do not meet.
    q, v = states
    moved = mb.Pose(q.position.at[:, 0].add(0.1), q.orientation), v
    lines = dict(zip(robot.names, outline_of(robot, moved, None).bodies, strict=True))
    assert np.all(apart(lines["crank"], lines["rod"]) > 0.05)


def test_rods_of_a_robot_end_at_its_bodies():
    problem = mj.problems.delta_robot()
    robot = delta_robot(problem.args)
    outline = outline_of(robot, problem.y0, None)
    ends = np.concatenate([line[0] for line in outline.bodies])
    assert len(outline.rods) == 6
    for rod in outline.rods:
        for end in rod[0]:
            assert np.min(np.linalg.norm(ends - end, axis=1)) < 1e-12


def test_points_of_the_drawing():
    """A pin belongs to both of its bodies, also of one that is drawn turned."""
    upper = mb.Body("upper", 1.0, 0.1, position=(0.5, 0.0))
    lower = mb.Body("lower", 1.0, 0.1, position=(1.0, -0.5), orientation=-np.pi / 2)
    pin = 1.0, 0.0
    joints = mb.Revolute("upper", mb.GROUND, at=(0.0, 0.0)), mb.Revolute("upper", "lower", at=pin)
    robot = mb.Assembly([upper, lower], joints)
    angles = {"upper": 0.4, "lower": -1.0}
    state = robot.state(None, angles, None, {"upper": 2.0}, assemble=True)
    position, velocity = robot.point(state, "upper", pin, drawn=True)
    other, _ = robot.point(state, "lower", pin, drawn=True)
    np.testing.assert_allclose(position, [np.cos(0.4), np.sin(0.4)], atol=1e-12)
    np.testing.assert_allclose(velocity, [-2 * np.sin(0.4), 2 * np.cos(0.4)], atol=1e-12)
    np.testing.assert_allclose(position, other, atol=1e-12)
    path = outline_of(robot, state, {"pin": ("lower", pin)}).markers["pin"]
    np.testing.assert_array_equal(path, other[None])


def test_several_states_at_once(crank):
    robot, states = crank
    gaps = robot.gaps(states[0], jnp.zeros(3))
    assert all(gap.shape[0] == 3 for gap in gaps.values())
    single = robot.gaps(jax.tree.map(lambda x: x[1], states[0]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1], b, atol=1e-14), gaps, single)


def test_draw_and_animate(crank, tmp_path):
    robot, states = crank
    markers = {"pin": ("crank", (0.0, 0.0))}
    ax = robot.draw(states, markers=markers)
    assert [text.get_text() for text in ax.texts] == ["pin"]
    assert robot.draw(states, ax=ax) is ax
    mpl.pyplot.close(ax.figure)
    robot.animate(states, tmp_path / "film.gif", seconds=0.2, markers=markers)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames in (3, 4)  # equal ones may be joined
    with pytest.raises(ValueError, match="states with a leading axis"):
        robot.animate(jax.tree.map(lambda x: x[0], states), tmp_path / "film.gif")
    with pytest.raises(ValueError, match="`path` must end in .gif"):
        robot.animate(states, tmp_path / "film.png")
    with pytest.raises(ValueError, match="`point` names the body 'foot'"):
        robot.draw(states, markers={"toe": ("foot", (0.0, 0.0))})


def test_axes_with_three_dimensions_are_refused(crank):
    robot, states = crank
    axes = mpl.figure.Figure().add_subplot(projection="3d")
    with pytest.raises(ValueError, match="`ax` must be axes with two dimensions"):
        robot.draw(states, ax=axes)
