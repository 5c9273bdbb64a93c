"""Couplings of joints, and links without mass, in the coordinates of joints."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifold_jax as mj


mb = mj.multibody
TORQUE, TIMES = 3.0, jnp.linspace(0.0, 4.0, 5)


def wheels(inertias, coefficients):
    """Two wheels about fixed axes, the second coupled to the first, which a motor turns."""
    at = {"a": (0.0, 0.0), "b": (2.0, 0.0)}
    bodies = [mb.Body(n, 1.0, own, position=at[n]) for n, own in zip(at, inertias)]
    hinges = [mb.Revolute(mb.GROUND, name, at=at[name], name=f"shaft {name}") for name in at]
    return mb.Assembly(
        bodies,
        [*hinges, mb.Coupling("shaft b", "shaft a", coefficients, name="mesh")],
        [mb.Motor("shaft a", TORQUE)],
    )


def test_wheels_that_mesh():
    """Many turns, with the closed form of the motion and of its gradients by all numbers."""
    args = jnp.array([0.2, 0.5]), jnp.array(-2.0)

    def exact(args):
        (first, second), ratio = args
        return TORQUE / (first + ratio**2 * second) * jnp.stack([jnp.ones(()), ratio])

    def weighted(args):
        joints = mb.JointCoordinates(wheels(*args))
        hook = mj.Projected(dfx.Tsit5(), joints.constraint)
        saveat = dfx.SaveAt(ts=TIMES)
        given = joints.terms, hook, 0.0, 4.0, 0.5, joints.state()
        fixed = dfx.ConstantStepSize()
        ys = mj.diffeqsolve(*given, saveat=saveat, stepsize_controller=fixed).ys[0]
        return jnp.sum(jnp.sin(ys) * (1 + TIMES[:, None])), ys

    ys_of = lambda args: TIMES[:, None] ** 2 / 2 * exact(args)[None]
    found, ys = jax.jit(jax.grad(weighted, has_aux=True))(args)
    assert jnp.max(jnp.abs(ys)) > 6 * jnp.pi
    np.testing.assert_allclose(ys, ys_of(args), rtol=1e-13)
    assert jnp.max(jnp.abs(ys[:, 1] - args[1] * ys[:, 0])) < 1e-14
    expected = jax.grad(lambda args: jnp.sum(jnp.sin(ys_of(args)) * (1 + TIMES[:, None])))(args)
    for part, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(part, other, rtol=1e-11)


def closed_linkage(coefficients, second=None, **options):
    """A four-bar linkage in space that moves in a plane, with a driven slider on its crank, and a wheel that is
    coupled to its rocker: equations of loops, of a drive and of a coupling, some dependent."""
    inertia, across = (0.1, 0.2, 0.2), (0.0, 1.0, 0.0)
    places = {"crank": (0.1, 0, 0.2), "coupler": (0.5, 0, 0.5), "rocker": (0.9, 0, 0.3)}
    places |= {"slider": (0.1, 0, 0.3), "wheel": (3.0, 0, 0)}
    bodies = [mb.Body(name, 1.0, inertia, position=at) for name, at in places.items()]
    hinge = lambda first, second, at, name: mb.Revolute(
        first, second, at=at, axis=across, name=name
    )
    joints = [
        hinge(mb.GROUND, "crank", (0.0, 0, 0), "in"),
        hinge("crank", "coupler", (0.2, 0, 0.4), "elbow"),
        hinge("coupler", "rocker", (0.8, 0, 0.6), "wrist"),
        hinge(mb.GROUND, "rocker", (1.0, 0, 0), "out"),
        hinge(mb.GROUND, "wheel", (3.0, 0, 0), "shaft"),
        mb.Prismatic("crank", "slider", at=(0.1, 0, 0.3), axis=(0.2, 0, 0.4), name="guide"),
        mb.Coupling("shaft", "out", coefficients)
        if second is None
        else mb.Coupling("out", second, 0.5),
        mb.Drive("guide", lambda t, args: 0.1 * (1 - jnp.cos(3 * t))),
    ]
    return mb.Assembly(bodies, joints, gravity=(0.0, 0.0, -9.81), **options)


def test_couplings_beside_loops_and_drives():
    """The independent equations give what all of them give, and a solve keeps them."""
    coefficients = (2.0, -0.5, 0.3)
    joints = mb.JointCoordinates(closed_linkage(coefficients).without_dependent_equations())
    assert {"out", "shaft"} <= set(joints.names)
    assert len(joints.independent) == len(joints.names) - 1
    everything = mb.JointCoordinates(closed_linkage(coefficients, redundant=True))
    hook = mj.Projected(dfx.Tsit5(), joints.constraint)
    given = joints.terms, hook, 0.0, 0.5, 0.01, joints.state()
    y = jax.tree.map(lambda leaf: leaf[-1], mj.diffeqsolve(*given).ys)
    q = dict(zip(joints.names, y[0]))
    z = q["out"]
    assert abs(z) > 0.1
    assert abs(q["shaft"] - (2 * z - 0.5 * z**2 + 0.3 * z**3)) < 1e-15
    assert abs(q["guide"] - 0.1 * (1 - jnp.cos(1.5))) < 1e-15
    gaps = joints.assembly.gaps(joints.poses(y)[0], 0.5)
    assert max(jnp.abs(gap).max() for gap in gaps.values()) < 1e-14
    found, expected = (
        eqx.filter_jit(own.system.accelerations)(0.5, y) for own in (joints, everything)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_a_free_body_on_links_without_mass():
    """Two sliders and a hinge between the ground and a body in the plane leave it free."""
    link = lambda name: mb.Body(name, 0.0, 0.0)
    body = mb.Body("body", 2.0, 0.3, position=(0.5, 0.3))
    joints = [
        mb.Prismatic(mb.GROUND, "x", at=(0.0, 0.0), axis=(1.0, 0.0), name="to the right"),
        mb.Prismatic("x", "y", at=(0.0, 0.0), axis=(1.0, 2.0), name="upwards"),
        mb.Revolute("y", "body", at=(0.0, 0.0), name="turn"),
    ]
    assembly = mb.Assembly(
        [body, link("y"), link("x")], joints, [mb.Torque("body", 0.6)], gravity=(0.0, -9.0)
    )
    free = mb.JointCoordinates(assembly)
    assert free.constraint is None
    assert free.names == ("turn", "upwards", "to the right")
    y = jnp.array([0.4, 0.2, -0.1]), jnp.array([3.0, 0.5, 0.2])

    def center(y):
        motion = assembly.motion(free.poses(y), "body")
        return motion.velocity, motion.angular_velocity

    field = lambda y: free.terms.vf(0.0, y, None)
    moving, turning = jax.jit(lambda y: jax.jvp(center, (y,), (field(y),))[1])(y)
    np.testing.assert_allclose(moving, [0.0, -9.0], atol=1e-12)
    np.testing.assert_allclose(turning, 2.0, rtol=1e-12)
    assert assembly.without_dependent_equations().independent is None


def test_motions_of_links_without_mass_alone_are_refused():
    """Two hinges about one axis through a link without mass, and the same with one of them held by a drive; a
    rod between two ball joints, whose spin is unknown."""
    body = mb.Body("body", 2.0, 0.3, position=(0.5, 0.0))
    link = mb.Body("link", 0.0, 0.0)
    hinges = [
        mb.Revolute(mb.GROUND, "link", at=(0.0, 0.0), name="h"),
        mb.Revolute("link", "body", at=(0.0, 0.0), name="k"),
    ]
    with pytest.raises(ValueError, match=r"joints \['h', 'k'\] can move bodies without mass"):
        mb.JointCoordinates(mb.Assembly([link, body], hinges))
    drive = mb.Drive("h", lambda t, args: args["rate"] * t)
    joints = mb.JointCoordinates(mb.Assembly([link, body], [*hinges, drive]))
    y = jnp.zeros(2), jnp.array([0.5, 0.2])
    a = joints.system.accelerations(0.0, y, {"rate": jnp.asarray(0.5)})
    np.testing.assert_allclose(a, 0.0, atol=1e-12)
    inertia = (0.1, 0.2, 0.2)
    bodies = [mb.Body("a", 1.0, inertia), mb.Body("rod", 0.0, np.zeros(3), position=(0.5, 0, 0))]
    bodies += [mb.Body("b", 1.0, inertia, position=(1.0, 0, 0.2))]
    balls = [
        mb.Spherical("a", "rod", at=(0.0, 0, 0), name="first"),
        mb.Spherical("rod", "b", at=(1.0, 0, 0), name="second"),
    ]
    with pytest.raises(ValueError, match="can move bodies without mass"):
        mb.JointCoordinates(mb.Assembly(bodies, balls))


def test_a_rod_without_mass_in_a_loop():
    """A slider-crank whose rod has no mass moves as one with a `Distance` instead."""
    crank = mb.Body("crank", 1.0, 0.1, position=(0.5, 0.0))
    slider = mb.Body("slider", 1.5, 0.1, position=(2.0, 1.0))
    ends = (1.0, 0.0), (2.0, 1.0)
    outer = [
        mb.Revolute(mb.GROUND, "crank", at=(0.0, 0.0)),
        mb.Prismatic(mb.GROUND, "slider", at=ends[1], axis=(1.0, 0.0)),
    ]
    hinges = [mb.Revolute("crank", "rod", at=ends[0]), mb.Revolute("rod", "slider", at=ends[1])]
    bodies, gravity = [crank, mb.Body("rod", 0.0, 0.0), slider], (0.0, -9.81)
    joints = mb.JointCoordinates(mb.Assembly(bodies, [*outer, *hinges], gravity=gravity))
    rod = mb.Distance("crank", "slider", between=ends)
    expected = mb.Assembly([crank, slider], [*outer, rod], gravity=gravity)
    y = expected.state({"slider": (1.9, 1.0)}, velocities={"slider": (0.7, 0.0)}, assemble=True)
    theirs = eqx.filter_jit(expected.system.accelerations)(0.0, y)
    start = joints.assembly.state(
        {"slider": (1.9, 1.0)}, velocities={"slider": (0.7, 0.0)}, assemble=True
    )
    q, v = joints.state(start)
    ours = dict(zip(joints.names, eqx.filter_jit(joints.system.accelerations)(0.0, (q, v))))
    sizes = [ours["Prismatic ground-slider"], ours["Revolute ground-crank"]]
    np.testing.assert_allclose(sizes, [theirs.position[1, 0], theirs.orientation[0]], rtol=1e-10)


def test_a_loop_closed_by_a_link_without_mass():
    """In space, drawn where what the link without mass does is not seen in the motions of the others: the
    equations left out are those that depend on others all the same."""
    points = [np.array(point) for point in ((0, 0, 0), (0.3, 0, 0.8), (1.5, 0, 0), (1.0, 0, 0))]
    names, masses = [mb.GROUND, "crank", "coupler", "rocker", mb.GROUND], (1.0, 0.0, 1.0)
    bodies = [
        mb.Body(name, mass, mass * np.array([0.1, 0.2, 0.2]), position=(first + second) / 2)
        for name, mass, first, second in zip(names[1:], masses, points, points[1:])
    ]
    joints = [
        mb.Revolute(first, second, at=at, axis=(0.0, 1.0, 0.0))
        for first, second, at in zip(names, names[1:], points)
    ]
    given = bodies, joints, [mb.Motor("Revolute ground-crank", 0.7)]
    found = []
    for assembly in (
        mb.Assembly(*given, gravity=(0.0, 0.0, -9.81)).without_dependent_equations(),
        mb.Assembly(*given, gravity=(0.0, 0.0, -9.81), redundant=True),
    ):
        linkage = mb.JointCoordinates(assembly)
        still = jnp.zeros(3), jnp.zeros(3)
        found.append(eqx.filter_jit(linkage.system.accelerations)(0.0, still))
    assert np.abs(found[1]).max() > 1
    np.testing.assert_allclose(*found, rtol=1e-10, atol=1e-10)


def test_messages(as_a_user_meets_it):
    assembly = wheels((0.2, 0.5), -2.0)
    with pytest.raises(
        ValueError, match=r"alone: `Coupling` \['mesh'\].\s*Solve\s*`mj.multibody.Joint"
    ):
        assembly.system  # noqa: B018
    with pytest.raises(ValueError, match="`Coupling`"):
        mb.parametrized(lambda args: assembly).terms.vf(0.0, assembly.state(), None)
    with pytest.raises(
        ValueError, match=r"mesh: `coefficients` must be a number or of shape \(4,\)"
    ):
        wheels((0.2, 0.5), np.ones((2, 2)))
    with pytest.raises(ValueError, match="mesh: `coefficients` must be finite"):
        wheels((0.2, 0.5), np.nan)
    bodies = [mb.Body("a", 1.0, 1.0), mb.Body("b", 0.0, 0.0)]
    hinge = mb.Revolute(mb.GROUND, "a", at=(0.0, 0.0), name="h")
    weld = mb.Fixed("a", "b", name="w")
    for one, other, message in (
        ("h", "h", "couples 'h' with itself"),
        ("h", "w", "the joint 'w' is a Fixed.*Couplings are of `Revolute`"),
        ("x", "h", "names the joint 'x', which is not there"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.Assembly(bodies, [hinge, weld, mb.Coupling(one, other, 1.0)])
    assert mb.JointCoordinates(mb.Assembly(bodies, [hinge, weld])).names == ("h",)
    loose = mb.Assembly(bodies, [hinge, mb.Revolute("a", "b", at=(1.0, 0.0))])
    with pytest.raises(ValueError, match=r"the bodies \['b'\] have no mass and move none that has"):
        mb.JointCoordinates(loose)
    with pytest.raises(
        ValueError, match="'b': `mass` must be positive, or zero with zero `inertia`"
    ):
        mb.Body("b", 0.0, 1.0)
    traced = jax.jit(lambda c: wheels((0.2, 0.5), (1.0, c)).couplings.coefficients)(0.5)
    np.testing.assert_allclose(traced, [[1.0, 0.5]])
    joints = mb.JointCoordinates(assembly)
    with pytest.raises(
        ValueError, match="the coupling 'mesh' does not hold for the coordinates .gap 0.3"
    ):
        joints.state(assembly.state(orientations={"b": 0.3}))
    turning = assembly.state(angular_velocities={"b": 0.3})
    with pytest.raises(ValueError, match="does not hold for the rates of coordinates"):
        joints.state(turning)
    # 0.5 is the ratio of the two rates in this drawing of the linkage, and in no other one.
    singular = closed_linkage(1.0, second="in").without_dependent_equations()
    with pytest.raises(
        ValueError, match=r"the couplings \['Coupling out'\] depend on closed loops"
    ):
        mb.JointCoordinates(singular)
    linkage = closed_linkage(1.0)
    twice = [mb.Coupling("h", "w", 2.0), mb.Coupling("w", "h", 0.5)]
    wheel = mb.Revolute("a", "c", at=(0.0, 0.0), name="w")
    both = mb.Assembly([bodies[0], mb.Body("c", 1.0, 1.0)], [hinge, wheel, *twice])
    with pytest.raises(ValueError, match="the couplings .* depend on each other"):
        mb.JointCoordinates(both)
    everywhere = [mb.Coupling("in", other, 1.0) for other in ("elbow", "wrist", "out")]
    joints = [
        mb.Revolute(mb.GROUND, "a", at=(0.0, 0.0), name="in"),
        mb.Revolute("a", "c", at=(1.0, 0.0), name="elbow"),
        mb.Revolute("c", "b", at=(2.0, 0.0), name="wrist"),
        mb.Revolute(mb.GROUND, "b", at=(3.0, 0.0), name="out"),
    ]
    assert linkage.couplings.names == ("Coupling shaft",)
    three = [mb.Body(name, 1.0, 1.0) for name in "abc"]
    with pytest.raises(
        ValueError, match="joints with `RotorInertia` or `Coupling`, .* form a closed loop"
    ):
        mb.JointCoordinates(mb.Assembly(three, [*joints, *everywhere]))
