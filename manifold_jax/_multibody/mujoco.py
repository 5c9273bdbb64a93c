"""Assemblies from MJCF and URDF, which MuJoCo reads and compiles, with springs, dampers and actuators."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base.user_functions import check_function
from .assembly import Assembly
from .attachment import joints_named_by
from .contacts import stops_at
from .forces import AbstractForce, JointSpring, RotationalDamper, RotorInertia
from .joints import AbstractRestraint
from .mujoco_actuators import actuators, tendon_springs
from .mujoco_checks import refuse_unsupported
from .mujoco_drawing import drawing_of
from .mujoco_equalities import equalities
from .mujoco_model import disabled, import_mujoco, in_effect, limited_joints, name_of
from .mujoco_tree import Tree


def from_mujoco(
    model: Any,
    *,
    control: Callable | None = None,
    joints: Sequence[AbstractRestraint] = (),
    forces: Sequence[AbstractForce] = (),
    stops: Callable | None = None,
    ignore: Sequence[str] = (),
    redundant: bool = False,
) -> Assembly:
    """The assembly of an MJCF or URDF file, by MuJoCo's parser (`pip install "manifold_jax[mjcf]"`).

    Joints are exact here, also those that MuJoCo keeps by soft constraints (`equality`): its
    `solref`, `solimp` and its integrator play no part.

    **Arguments:**

    - `model`: a `mujoco.MjModel`, a string of XML, or the path of a file.
    - `control`: `f(t, args)` returns the controls `(nu,)` of its actuators; `None` for zeros, as in
        MuJoCo.
    - `joints`, `forces`: further ones for the [`Assembly`][], such as [`GroundContact`][].
    - `stops`: `f(joint, lower, upper)` returns the force at the limits (rad or m, counted from the drawing: its `range`
        less `qpos0`) of a limited hinge or slide, or `None` for no stop; such as
        `functools.partial(mb.JointStop, stiffness=1e3)`.
    - `ignore`: what to leave out instead of refusing it, by the words of the error message, such as
        `("contact", "joint limit")`.
    - `redundant`: as for [`Assembly`][].

    Read are bodies with their inertias and any number of hinge, slide and ball joints each, or a free one;
    stiffness, damping and armature of hinges and slides, damping of ball joints; `equality` of the types connect,
    weld and joint; gravity; fixed tendons; actuators of hinges, slides and fixed tendons with constant gain and affine
    bias (motor, position, velocity); the flags that switch off any of these. The drawing is the pose `qpos0`, with coupled
    joints where their couplings have them.

    Names are those of the file, `"body 3"` for an element without. MuJoCo's are unique among elements of one type alone:
    an equality that is called as a joint is `"equality j"` here, a tendon with a spring that is called as an actuator
    `"tendon j"`, and `"unnamed body 3"` is one without a name where another has the name `"body 3"`.

    Angles of hinges that springs, servo motors (position actuators) and tendons turn beyond `pi` are those of MuJoCo in
    [`JointCoordinates`][] alone. Where `ctrlrange`, `range` or `springref` reach there, the poses of bodies are refused as
    coordinates; without a `ctrlrange` a servo motor that is told to turn there turns for ever in them.

    A body with several joints hangs on links without mass, `"torso (rootx)"` is the one of the body torso that its
    joint rootx moves. These, armature and couplings of joints need the coordinates of joints: solve
    [`JointCoordinates`][] of the result. But two perpendicular hinges through one point are a universal
    joint, and hinge and slide on one axis a cylindrical one, if nothing acts on one of them alone.

    **Raises** `ValueError` with the names of all elements that are not supported: spatial tendons, contacts,
    limits without `stops`, friction, and so on. Elements without effect on the motion (geometries that do not
    collide, sites, sensors, cameras) are left out.
    """
    mujoco = import_mujoco()
    model = load(mujoco, model)
    refuse_unsupported(mujoco, model, ignore, stops is not None)
    if control is not None:
        check_function("control", control, "f(t, args)")
    limited = [] if stops is None else limited_joints(mujoco, model)
    named = joints_named_by([*joints, *forces])
    named |= {name_of(mujoco, model, "joint", j) for j in limited}
    tree = Tree(mujoco, model, drawing_of(mujoco, model), named)
    gravity = np.zeros(3) if disabled(mujoco, model, "GRAVITY") else model.opt.gravity
    bodies, own = tree.bodies(), tree.joints()
    taken = {joint.name for joint in own if joint.name is not None}
    if not bodies:
        raise ValueError(
            "`model` has no body that moves: joints and free bodies belong in its `worldbody`."
        )
    acting = [*_passive_forces(tree), *actuators(tree, control), *tendon_springs(tree)]
    acting += stops_at(stops, {tree.joint_of[j]: _limits(tree, j) for j in limited})
    return Assembly(
        bodies,
        [*own, *equalities(tree, taken), *joints],
        [*acting, *forces],
        gravity=gravity,
        redundant=redundant,
    )


def load(mujoco: Any, model: Any) -> Any:
    if isinstance(model, mujoco.MjModel):
        return model
    if isinstance(model, Path) or (isinstance(model, str) and "<" not in model):
        return mujoco.MjModel.from_xml_path(str(model))
    if not isinstance(model, str):
        raise TypeError(
            f"`model` must be a `mujoco.MjModel`, a string of XML or the path of a file, got {type(model).__name__}."
        )
    return mujoco.MjModel.from_xml_string(model)


def _limits(tree: Tree, j: int) -> tuple[float, float]:
    """Return the limits of a hinge or slide, counted from the drawing."""
    lower, upper = tree.model.jnt_range[j] - tree.drawing.qpos[tree.model.jnt_qposadr[j]]
    return float(lower), float(upper)


def _passive_forces(tree: Tree) -> list[AbstractForce]:
    """Return springs, dampers and rotors of joints."""
    mujoco, model, found = tree.mujoco, tree.model, []
    stiffnesses, dampings = (in_effect(mujoco, model, n) for n in ("jnt_stiffness", "dof_damping"))
    for j, name in tree.joint_of.items():
        stiffness, damping = stiffnesses[j], dampings[model.jnt_dofadr[j]]
        at = model.jnt_qposadr[j]
        if stiffness != 0 or damping != 0:
            rest = model.qpos_spring[at] - tree.drawing.qpos[at]
            found.append(JointSpring(name, stiffness, rest, damping))  # pyright: ignore[reportArgumentType]
        if (armature := model.dof_armature[model.jnt_dofadr[j]]) != 0:
            found.append(RotorInertia(name, armature))  # pyright: ignore[reportArgumentType, reportCallIssue]
    for j, (parent, body) in tree.balls.items():
        damping, *others = dampings[model.dof_jntid == j]
        if damping != 0 and all(damping == other for other in others):
            name = f"damping of {tree.name('joint', j)}"
            found.append(RotationalDamper(parent, body, damping, name))  # pyright: ignore[reportCallIssue]
    return found
