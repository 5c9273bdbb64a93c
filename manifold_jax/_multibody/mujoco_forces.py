"""Springs, dampers and actuators of a MuJoCo model."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .checks import floating
from .forces import AbstractForce, JointSpring, Motor
from .mujoco_checks import actuator_fault, disabled
from .mujoco_tree import Tree


def springs(tree: Tree) -> list[AbstractForce]:
    model, found = tree.model, []
    for j, name in tree.joint_of.items():
        stiffness, damping = model.jnt_stiffness[j], model.dof_damping[model.jnt_dofadr[j]]
        at = model.jnt_qposadr[j]
        if stiffness != 0 or damping != 0:
            rest = model.qpos_spring[at] - model.qpos0[at]
            found.append(JointSpring(name, stiffness, rest, damping))  # pyright: ignore[reportArgumentType]
    return found


def actuators(tree: Tree, control: Callable | None) -> list[AbstractForce]:
    """The torque is `gear (gain ctrl + b0 + b1 gear x + b2 gear x')`."""
    mujoco, model, found = tree.mujoco, tree.model, []
    if disabled(mujoco, model, "ACTUATION"):
        return found
    for i in range(model.nactuator):
        # those with a fault were refused before, unless the user wants to leave them out
        if not (actuator_fault(mujoco, model, i) or _group_disabled(model, i)):
            found += _actuator(tree, control, i)
    return found


def _group_disabled(model: Any, i: int) -> bool:
    """The groups that MuJoCo can switch off are 0 to 30."""
    group = int(model.actuator_group[i])
    return 0 <= group <= 30 and bool(int(model.opt.disableactuator) >> group & 1)


def _actuator(tree: Tree, control: Callable | None, i: int) -> list[AbstractForce]:
    model = tree.model
    joint, name = tree.joint_of[model.actuator_trnid[i, 0]], tree.name("actuator", i)
    zero = float(model.qpos0[model.jnt_qposadr[model.actuator_trnid[i, 0]]])
    gear, gain = float(model.actuator_gear[i, 0]), float(model.actuator_gainprm[i, 0])
    affine = int(tree.mujoco.mjtBias.mjBIAS_AFFINE)
    bias = model.actuator_biasprm[i, :3] * (model.actuator_biastype[i] == affine)
    limits = tuple(map(float, model.actuator_ctrlrange[i]))
    limits = limits if model.actuator_ctrllimited[i] else (-np.inf, np.inf)
    constant = gear * float(bias[0])
    drive = _Drive(control, int(model.actuator_ctrladr[i]), gear * gain, limits, constant)  # pyright: ignore[reportArgumentType]
    found: list[Any] = [Motor(joint, drive, name=name)]  # pyright: ignore[reportCallIssue]
    if bias[1] != 0 or bias[2] != 0:
        stiffness, damping = -(gear**2) * bias[1], -(gear**2) * bias[2]
        found.append(JointSpring(joint, stiffness, -zero, damping, name=f"{name} bias"))  # pyright: ignore[reportCallIssue]
    return found


class _Drive(eqx.Module):
    """One of the controls, within its limits, times a factor, and a constant."""

    control: Callable | None
    index: int = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    limits: tuple[float, float] = eqx.field(static=True)
    constant: float = eqx.field(static=True)

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
        return self.factor * jnp.clip(value, *self.limits) + self.constant
