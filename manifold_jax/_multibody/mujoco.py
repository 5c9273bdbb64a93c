"""Assemblies from MJCF and URDF, which MuJoCo reads and compiles."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base.user_functions import check_function
from .assembly import Assembly
from .bodies import Pose
from .checks import floating
from .mujoco_checks import disabled, import_mujoco, refuse_unsupported
from .mujoco_forces import actuators, springs
from .mujoco_tree import quaternion_of, Tree
from .rotations import quaternion_rate


def from_mujoco(
    model: Any,
    *,
    control: Callable | None = None,
    ignore: Sequence[str] = (),
    redundant: bool = False,
) -> Assembly:
    """The assembly of an MJCF or URDF file, by MuJoCo's parser (`pip install
    "manifold_jax[mjcf]"`).

    Joints are exact here, also those that MuJoCo keeps by soft constraints (`equality`): its
    `solref`, `solimp` and its integrator play no part.

    **Arguments:**

    - `model`: a `mujoco.MjModel`, a string of XML, or the path of a file.
    - `control`: `f(t, args)` returns the controls `(nu,)` of its actuators; `None` for zeros, as in
        MuJoCo.
    - `ignore`: what to leave out instead of refusing it, by the words of the error message, such as
        `("contact", "joint limit")`.
    - `redundant`: as for [`Assembly`][].

    Read are bodies with their inertias; hinge, slide, ball and free joints, two hinges with
    perpendicular axes through one point (a universal joint), hinge and slide on one axis (a
    cylindrical one); stiffness and damping of hinges and slides; `equality` of the types connect and
    weld; gravity; actuators of joints with constant gain and affine bias (motor, position, velocity,
    damper). The drawing is the pose `qpos0`. Stiffness of hinges counts angles from `-pi` to `pi`.

    **Raises** `ValueError` with the names of all elements that are not supported: tendons, contacts,
    limits, friction, armature, and so on. What does not act on the motion (geometries that do not
    collide, sites, sensors, cameras) is left out.
    """
    mujoco = import_mujoco()
    model = load(mujoco, model)
    refuse_unsupported(mujoco, model, ignore)
    if control is not None:
        check_function("control", control, "f(t, args)")
    drawing = mujoco.MjData(model)
    mujoco.mj_kinematics(model, drawing)
    mujoco.mj_comPos(model, drawing)
    tree = Tree(mujoco, model, drawing)
    gravity = np.zeros(3) if disabled(mujoco, model, "GRAVITY") else model.opt.gravity
    bodies, joints = tree.bodies(), tree.joints()
    if not bodies:
        raise ValueError(
            "`model` has no body that moves: joints and free bodies belong in its `worldbody`."
        )
    return Assembly(
        bodies,
        joints + tree.equalities(),
        springs(tree) + actuators(tree, control),
        gravity=gravity,
        redundant=redundant,
    )


def state_of_mujoco(assembly: Assembly, model: Any, data: Any) -> tuple[Pose, Pose]:
    """The state `(q, v)` of an assembly of [`from_mujoco`][] where MuJoCo's `data` has `qpos` and
    `qvel`. Calls `mj_forward` on it."""
    mujoco = import_mujoco()
    mujoco.mj_forward(model, data)
    positions, orientations, moving, spins = [], [], [], []
    kind, both = mujoco.mjtObj.mjOBJ_BODY, np.zeros(6)
    for name in assembly.names:
        i = mujoco.mj_name2id(model, kind, name)
        i = int(name.removeprefix("body ")) if i < 0 else i
        mujoco.mj_objectVelocity(model, data, kind, i, both, 0)
        positions.append(data.xipos[i].copy())
        orientations.append(quaternion_of(mujoco, data.ximat[i]))
        spins.append(both[:3].copy())
        moving.append(both[3:].copy())
    p = floating(np.stack(orientations))
    v = Pose(floating(np.stack(moving)), quaternion_rate(p, floating(np.stack(spins))))
    return Pose(floating(np.stack(positions)), p), v


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
