"""Assemblies from MJCF and URDF, which MuJoCo reads and compiles."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, RealScalarLike
from .._user_function import check_function
from .assembly import Assembly
from .bodies import Body, GROUND, Pose
from .checks import floating
from .forces import AbstractForce, JointSpring, Motor
from .joints import (
    AbstractJoint,
    Cylindrical,
    Fixed,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
)
from .mujoco_checks import (
    actuator_fault,
    equality_fault,
    import_mujoco,
    Index,
    name_of,
    refuse_unsupported,
)
from .start import quaternion_rate


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
    tree = _Tree(mujoco, model, drawing)
    gravity = model.opt.gravity
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY):
        gravity = np.zeros(3)
    joints = tree.joints()
    return Assembly(
        tree.bodies(),
        joints + tree.equalities(),
        tree.springs() + tree.actuators(control),
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
        orientations.append(_quaternion(mujoco, data.ximat[i]))
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


class _Tree:
    """Bodies and joints of a model in the pose `qpos0`."""

    def __init__(self, mujoco: Any, model: Any, drawing: Any):
        self.mujoco, self.model, self.drawing = mujoco, model, drawing
        self.joint_of: dict[int, str] = {}  # those with a coordinate, by their index

    def name(self, kind: str, i: Index) -> str:
        return name_of(self.mujoco, self.model, kind, i)

    def body(self, i: Index) -> str:
        """The name of the body that body `i` is part of."""
        model = self.model
        if model.body_weldid[i] == 0:
            return GROUND
        while model.body_mass[i] == 0 and model.body_jntnum[i] == 0:
            i = model.body_parentid[i]
        return self.name("body", i)

    def bodies(self) -> list[Body]:
        model, drawing = self.model, self.drawing
        return [
            Body(
                self.name("body", i),
                model.body_mass[i],
                model.body_inertia[i],
                position=drawing.xipos[i],
                orientation=_quaternion(self.mujoco, drawing.ximat[i]),
            )
            for i in range(1, model.nbody)
            if self.body(i) == self.name("body", i)
        ]

    def joints(self) -> list[AbstractJoint]:
        found = []
        for i in range(1, self.model.nbody):
            if self.body(i) == self.name("body", i):
                found += self._joint(i)
        return found

    def _joint(self, i: Index) -> list[AbstractJoint]:
        model, drawing, kinds = self.model, self.drawing, self.mujoco.mjtJoint
        start = model.body_jntadr[i]
        own = list(range(start, start + model.body_jntnum[i]))
        parent, body = self.body(model.body_parentid[i]), self.name("body", i)
        if not own:
            return [Fixed(parent, body, name=f"weld of {body}")]
        types = tuple(kinds(int(model.jnt_type[j])).name.removeprefix("mjJNT_") for j in own)
        at, axes = drawing.xanchor[own[0]], [drawing.xaxis[j] for j in own]
        one_point = all(np.allclose(drawing.xanchor[j], at, atol=1e-12) for j in own)
        name = " ".join(self.name("joint", j) for j in own)
        if types == ("FREE",):
            return []
        if types == ("BALL",):
            return [Spherical(parent, body, at=at, name=name)]
        if len(own) == 1:
            self.joint_of[own[0]] = name
            kind = Revolute if types == ("HINGE",) else Prismatic
            return [kind(parent, body, at=at, axis=axes[0], name=name)]
        if types == ("HINGE", "HINGE") and one_point and abs(axes[0] @ axes[1]) < 1e-9:
            return [Universal(parent, body, at=at, axis=(axes[0], axes[1]), name=name)]
        parallel = np.linalg.norm(np.cross(axes[0], axes[1])) < 1e-9
        if sorted(types) == ["HINGE", "SLIDE"] and parallel:
            hinge = own[types.index("HINGE")]
            return [Cylindrical(parent, body, at=drawing.xanchor[hinge], axis=axes[0], name=name)]
        raise ValueError(
            f"The body {body!r} has the joints {name!r} ({', '.join(types).lower()}), which together are none of the joints "
            "supported: one hinge, slide, ball or free; two perpendicular hinges through one point; hinge and slide on "
            "one axis."
        )

    def equalities(self) -> list[AbstractJoint]:
        model, drawing = self.model, self.drawing
        if model.opt.disableflags & int(self.mujoco.mjtDisableBit.mjDSBL_EQUALITY):
            return []
        found = []
        for e in range(model.neq):
            if not model.eq_active0[e] or equality_fault(self.mujoco, model, e):
                continue
            name, data = self.name("equality", e), model.eq_data[e]
            of_sites = int(model.eq_objtype[e]) == int(self.mujoco.mjtObj.mjOBJ_SITE)
            objects = model.eq_obj1id[e], model.eq_obj2id[e]
            bodies = [model.site_bodyid[i] for i in objects] if of_sites else list(objects)
            if model.eq_type[e] == int(self.mujoco.mjtEq.mjEQ_WELD):
                found.append(self._weld(name, bodies, objects, data, of_sites))
                continue
            local = (data[0:3], data[3:6])
            where = [
                drawing.site_xpos[i] if of_sites else self._in_space(b, p)
                for i, b, p in zip(objects, bodies, local, strict=True)
            ]
            points = tuple(self._in_body(b, p) for b, p in zip(bodies, where, strict=True))
            found.append(Spherical(*map(self.body, bodies), points=points, name=name))
        return found

    def _weld(self, name: str, bodies: list, objects: tuple, data: Any, of_sites: bool) -> Fixed:
        drawing = self.drawing
        first, second = (drawing.xmat[b].reshape(3, 3) for b in bodies)
        turned, wanted = np.zeros(9), np.eye(3)
        if not of_sites:
            self.mujoco.mju_quat2Mat(turned, data[6:10])
            wanted = turned.reshape(3, 3)
            shift = self._in_space(bodies[1], data[0:3]) - self._in_space(bodies[0], data[3:6])
            at = self._in_space(bodies[1], data[0:3])
        else:
            first, second = (drawing.site_xmat[i].reshape(3, 3) for i in objects)
            shift = drawing.site_xpos[objects[1]] - drawing.site_xpos[objects[0]]
            at = drawing.site_xpos[objects[1]]
        if max(np.abs(shift).max(), np.abs(first.T @ second - wanted).max()) > 1e-6:
            raise ValueError(
                f"The weld {name!r} holds its bodies in another pose than that of `qpos0`, which is not supported: give them "
                "in the file as they are welded."
            )
        return Fixed(*map(self.body, bodies), at=at, name=name)

    def _in_space(self, body: Index, point: np.ndarray) -> np.ndarray:
        """Of a point in MuJoCo's frame of a body."""
        return self.drawing.xpos[body] + self.drawing.xmat[body].reshape(3, 3) @ point

    def _in_body(self, body: Index, point: np.ndarray) -> np.ndarray:
        """In our frame, that of its inertia."""
        name = self.body(body)
        if name == GROUND:
            return point
        while self.name("body", body) != name:
            body = self.model.body_parentid[body]
        return self.drawing.ximat[body].reshape(3, 3).T @ (point - self.drawing.xipos[body])

    def springs(self) -> list[AbstractForce]:
        model, found = self.model, []
        for j, name in self.joint_of.items():
            stiffness, damping = model.jnt_stiffness[j], model.dof_damping[model.jnt_dofadr[j]]
            at = model.jnt_qposadr[j]
            if stiffness != 0 or damping != 0:
                rest = model.qpos_spring[at] - model.qpos0[at]
                found.append(JointSpring(name, stiffness, rest, damping))  # pyright: ignore[reportArgumentType]
        return found

    def actuators(self, control: Callable | None) -> list[AbstractForce]:
        """The torque is `gear (gain ctrl + b0 + b1 gear x + b2 gear x')`."""
        model, found = self.model, []
        if model.opt.disableflags & int(self.mujoco.mjtDisableBit.mjDSBL_ACTUATION):
            return found
        for i in range(model.nactuator):
            if actuator_fault(self.mujoco, model, i):
                continue  # refused before, unless the user wants to leave it out
            joint, name = self.joint_of[model.actuator_trnid[i, 0]], self.name("actuator", i)
            zero = float(model.qpos0[model.jnt_qposadr[model.actuator_trnid[i, 0]]])
            gear, gain = float(model.actuator_gear[i, 0]), float(model.actuator_gainprm[i, 0])
            affine = int(self.mujoco.mjtBias.mjBIAS_AFFINE)
            bias = model.actuator_biasprm[i, :3] * (model.actuator_biastype[i] == affine)
            limits = tuple(map(float, model.actuator_ctrlrange[i]))
            limits = limits if model.actuator_ctrllimited[i] else (-np.inf, np.inf)
            drive = _Drive(control, int(model.actuator_ctrladr[i]), gear * gain, limits)  # pyright: ignore[reportArgumentType]
            found.append(Motor(joint, _Sum(drive, gear * float(bias[0])), name=name))  # pyright: ignore[reportCallIssue]
            if bias[1] != 0 or bias[2] != 0:
                stiffness, damping = -(gear**2) * bias[1], -(gear**2) * bias[2]
                found.append(JointSpring(joint, stiffness, -zero, damping, name=f"{name} bias"))  # pyright: ignore[reportCallIssue]
        return found


class _Drive(eqx.Module):
    """One of the controls, within its limits, times a factor."""

    control: Callable | None
    index: int = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    limits: tuple[float, float] = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, args: Args) -> Float[Array, ""]:
        if self.control is None:
            value = jnp.zeros(())
        else:
            value = floating(self.control(t, args))
            if value.ndim != 1 or value.shape[0] <= self.index:
                raise ValueError(
                    f"`control` must return the controls of all actuators, shape (nu,), got {value.shape}."
                )
            value = value[self.index]
        return self.factor * jnp.clip(value, *self.limits)


class _Sum(eqx.Module):
    drive: _Drive
    constant: float = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, args: Args) -> Float[Array, ""]:
        return self.drive(t, args) + self.constant


def _quaternion(mujoco: Any, matrix: np.ndarray) -> np.ndarray:
    p = np.zeros(4)
    mujoco.mju_mat2Quat(p, np.ascontiguousarray(matrix).reshape(9))
    return p
