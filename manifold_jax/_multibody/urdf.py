"""Robots from URDF files, with closed loops."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .assembly import Assembly
from .attachment import joints_named_by
from .ball_joints import merge_hinges
from .bodies import GROUND, Pose
from .checks import check_shape
from .closures import motions_of, read_additions
from .forces import AbstractForce
from .joints import (
    AbstractJoint,
    AbstractRestraint,
    Coupling,
    Spherical,
)
from .kinematic_tree import KinematicTree
from .loops import close_loops, Closure
from .rigid_groups import body_names, connections, Groups, joint_between
from .rotations import rotation_matrix
from .urdf_elements import Joint, Placement, read_elements
from .urdf_forces import dampers_of, motors_of, stops_of


class LinkFrame(NamedTuple):
    """The frame of a link: the body that the link is part of, and where the frame is in the drawing."""

    body: str
    at: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]


class Robot(eqx.Module):
    """What [`read_urdf`][manifold_jax.multibody.read_urdf] returns.

    **Attributes:**

    - `assembly`: the [`Assembly`][manifold_jax.multibody.Assembly], drawn with all loops closed.
    - `configuration`: the coordinates (rad or m) of hinges and sliders in the drawing, by the names
        of the file. `assembly.joint_coordinates` counts from there.
    - `limits`: lower and upper limits of these in the file. Only `stops` of
        `read_urdf` enforce them, and yield; an [`impact`][manifold_jax.impact] does not.
    - `motors`: the names of joints with motors, in the order of the values of `control`.
    - `frames`: for every link of the file its body, and origin `at` and rotation of its frame in the
        drawing. `markers={"foot": robot.frames["foot"][:2]}` draws the path of its origin.
    """

    assembly: Assembly
    configuration: dict[str, float] = eqx.field(static=True)
    limits: dict[str, tuple[float, float]] = eqx.field(static=True)
    motors: tuple[str, ...] = eqx.field(static=True)
    frames: dict[str, LinkFrame] = eqx.field(static=True)

    def frame(self, y: tuple[Pose, Pose], link: str) -> tuple[Array, Array]:
        """Return origin `(3,)` and rotation matrix `(3, 3)` of the frame of a link, for a state or for
        states with leading axes."""
        if link not in self.frames:
            raise ValueError(f"`link` is {link!r}; links are {list(self.frames)[:12]}.")
        body, at, rotation = self.frames[link]
        origin, _ = self.assembly.point(y, body, at, drawn=True)
        if body == GROUND:
            turned = jnp.broadcast_to(jnp.eye(3, dtype=origin.dtype), (*origin.shape, 3))
        else:
            turned = rotation_matrix(self.assembly.motion(y, body).orientation)
        return origin, turned @ jnp.asarray(rotation, origin.dtype)


def read_urdf(
    file: Any,
    *,
    closures: Any = None,
    floating_base: bool = False,
    configuration: Mapping[str, float] | None = None,
    control: Callable | None = None,
    joints: Sequence[AbstractRestraint] = (),
    forces: Sequence[AbstractForce] = (),
    stops: Callable | None = None,
    gravity: Any = (0.0, 0.0, -9.81),
    ignore: Sequence[str] = (),
) -> Robot:
    """Read a robot from a URDF file, with closed loops.

    URDF describes trees. Loops are closed by `closures`, in the form of the collection
    [example-parallel-robots](https://github.com/Gepetto/example-parallel-robots):

    ```yaml
    closed_loop: [['elbow_left', 'elbow_right']]  # links whose frames coincide
    type: ['6d']                                  # a weld; '3d': a ball joint, only origins
    name_mot: ['shoulder_left', 'shoulder_right'] # joints with motors
    joint_name: ['ankle', 'knee']                 # joints of another type than in the URDF:
    joint_type: ['SPHERICAL', 'UJOINT_XY']        # or 'FIXED'; axes are those of the joint's frame
    ```

    Links that are welded together are one body, with the name of the heaviest one; links without mass
    between hinges become universal or ball joints. Of the equations of its joints as many are solved as are
    independent, see `Assembly.without_dependent_equations`.

    **Arguments:**

    - `file`: the path of the URDF, or a string of XML. Meshes are not read.
    - `closures`: the path of a YAML file as above (extra `robots`), or a mapping.
    - `floating_base`: whether the root link moves freely; otherwise it is the ground.
    - `configuration`: joint coordinates (rad or m) of the drawing, by name. The other ones are those for
        which all loops are closed and that are nearest to zero.
    - `control`: `f(t, args)` returns the torques or forces `(number of motors,)` of the motors; `None`
        for none.
    - `joints`, `forces`: further ones for the [`Assembly`][], such as [`Drive`][] and [`Motor`][].
    - `stops`: `f(joint, lower, upper)` returns the force at the limits (rad or m, counted from the drawing) of a hinge
        or slider in the file, or `None` for no stop; such as `functools.partial(mb.JointStop, stiffness=1e3)`. Limits
        of a hinge that are a turn apart or more need [`JointCoordinates`][]. Hinges with limits are then not joined to universal
        joints: links without mass between them need [`JointCoordinates`][]. Without `stops` limits are not enforced.
    - `gravity` (m/s^2).
    - `ignore`: what to leave out, some of `("friction", "mimic")`: Coulomb friction is not supported; joints
        that mimic others are a [`Coupling`][] with them, which needs [`JointCoordinates`][].

    **Returns:** a [`Robot`][].

    **Raises** `ValueError` with the names in the file: for loops that cannot be closed and their gaps (m or
    rad), links without mass where it is needed, inertias that no body has, Coulomb friction unless ignored.
    `from_mujoco` reads URDF, too, without loops.
    """
    links, elements = read_elements(file)
    elements = _supported(elements, ignore)
    additions = read_additions(closures, links, elements)
    mimics = {name for j in elements if j.mimic for name in (j.name, j.mimic.other)}
    limits = {joint.name: joint.limits for joint in elements if joint.limits is not None}
    named = joints_named_by([*joints, *forces]) | (set() if stops is None else set(limits))
    links, elements = merge_hinges(links, elements, additions.used | mimics | named)
    motions = {joint.name: motions_of(joint, additions.joint_types) for joint in elements}
    tree = KinematicTree(links, elements, motions)
    _check_mimics(tree)
    x = _closed(tree, additions.closures, configuration or {})
    placed, axes = tree.place(x)
    groups = Groups(tree, additions.closures, placed)
    loops = [loop for loop in additions.closures if not loop.is_rigid]
    ends = {groups.of(link) for loop in loops for link in (loop.first, loop.second)}
    used = {joint.name for joint in elements if joint.damping != 0}
    used |= mimics | named | set(additions.motors)
    found = connections(tree, groups, axes, ends, used, mimics)
    connected = ends | {group for c in found for group in (c.first, c.second)}
    names = body_names(groups, tree.root, floating_base, connected)
    own = [joint_between(connection, names) for connection in found]
    own += _ball_joints(additions.closures, groups, names, placed)
    drawn = _coordinates(tree, x)
    acting = dampers_of(elements, own) + motors_of(additions.motors, own, control)
    acting += stops_of(stops, limits, drawn, own)
    bodies = [groups.body(group) for group in names if names[group] != GROUND]
    if not bodies:
        raise ValueError("`file` has no link with mass that moves.")
    joints = [*own, *_couplings(tree), *joints]
    assembly = Assembly(bodies, joints, [*acting, *forces], gravity=gravity)
    return Robot(
        assembly.without_dependent_equations(),
        drawn,
        limits,
        additions.motors,
        _frames(groups, names, placed),
    )


def _frames(
    groups: Groups, names: Mapping[str, str], placed: Mapping[str, Placement]
) -> dict[str, LinkFrame]:
    as_tuple = lambda matrix: tuple(map(tuple, matrix.tolist()))
    return {
        link: LinkFrame(names[group], tuple(at.origin.tolist()), as_tuple(at.rotation))
        for link, at in placed.items()
        if (group := groups.of(link)) in names
    }


def _supported(joints: Sequence[Joint], ignore: Sequence[str]) -> list[Joint]:
    """Return the joints without what is to be ignored."""
    if isinstance(ignore, str):
        raise TypeError(f"`ignore` must be a sequence of words, write `ignore=({ignore!r},)`.")
    if unknown := sorted(set(ignore) - {"friction", "mimic"}):
        raise ValueError(f"`ignore` has {unknown}; known are 'friction' and 'mimic'.")
    rubbing = [joint.name for joint in joints if joint.friction != 0]
    if rubbing and "friction" not in ignore:
        raise ValueError(
            f"`file` has joints with <friction>, which is not supported: {', '.join(rubbing[:10])}. Leave it out by "
            "`ignore=('friction',)`, and add a `JointFriction` by `forces`."
        )
    if "mimic" in ignore:
        return [joint._replace(mimic=None) for joint in joints]
    return list(joints)


def _couplings(tree: KinematicTree) -> list[Coupling]:
    """Return the couplings of joints that mimic others; offsets are in the drawing."""
    return [
        Coupling(
            joint.name, joint.mimic.other, joint.mimic.multiplier, name=f"mimic of {joint.name}"
        )
        for joint in tree.order
        if joint.mimic is not None
    ]


def _check_mimics(tree: KinematicTree) -> None:
    single = {name for name, own in tree.columns.items() if len(own) == 1}
    for joint in tree.order:
        if joint.mimic is not None and (bad := {joint.name, joint.mimic.other} - single):
            raise ValueError(
                f"`file`: <mimic> of {joint.name!r} needs two joints with one coordinate each; {sorted(bad)} have not, or are "
                "not there."
            )


def _closed(
    tree: KinematicTree, closures: Sequence[Closure], configuration: Mapping[str, float]
) -> np.ndarray:
    """Return the coordinates of the drawing."""
    x, held = np.zeros(tree.size), []
    for name, value in configuration.items():
        own = tree.columns.get(name, ())
        if len(own) != 1:
            known = [name for name, own in tree.columns.items() if len(own) == 1]
            raise ValueError(
                f"`configuration` has {name!r}, which is no hinge or slider of `file`; these are {known[:12]}."
            )
        x[own[0]] = check_shape(f"`configuration` of {name!r}", value, ())
        held += own
    return close_loops(tree, closures, x, held)


def _coordinates(tree: KinematicTree, x: np.ndarray) -> dict[str, float]:
    return {name: float(x[own[0]]) for name, own in tree.columns.items() if len(own) == 1}


def _ball_joints(
    closures: Sequence[Closure],
    groups: Groups,
    names: Mapping[str, str],
    placed: Mapping[str, Placement],
) -> list[AbstractJoint]:
    """Return the joints of loops that are closed at a point."""
    found = []
    for closure in closures:
        if closure.is_rigid:
            continue
        bodies = [names[groups.of(link)] for link in (closure.first, closure.second)]
        if bodies[0] == bodies[1]:
            raise ValueError(f"The loop {closure.name} connects {bodies[0]!r} with itself.")
        found.append(Spherical(*bodies, at=placed[closure.first].origin, name=closure.name))
    return found
