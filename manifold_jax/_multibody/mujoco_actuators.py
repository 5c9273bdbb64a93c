"""Actuators and fixed tendons of a MuJoCo model."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .checks import AbstractBounded, floating
from .forces import AbstractForce, Motor, Tendon
from .mujoco_checks import actuator_fault, is_of_tendon, tendon_fault
from .mujoco_model import disabled, in_effect
from .mujoco_tree import Tree


# Type checkers do not know the arguments of dataclasses whose fields are `Any` in abstract bases.
_MOTOR: Any = Motor
_TENDON: Any = Tendon


def actuators(tree: Tree, control: Callable | None) -> list[AbstractForce]:
    """Return motors for actuators, and tendons where these go through several joints, have limits or are servo
    motors: the torque is `gear (gain ctrl + b0 + b1 gear x + b2 gear x')`."""
    mujoco, model, found = tree.mujoco, tree.model, []
    if disabled(mujoco, model, "ACTUATION"):
        return found
    for i in range(model.nactuator):
        # those with a fault were refused before, unless the user ignores them
        if not (actuator_fault(mujoco, model, i) or _group_disabled(model, i)):
            found += _actuator(tree, control, i)
    return found


def _group_disabled(model: Any, i: int) -> bool:
    """Whether the group of an actuator is disabled; MuJoCo can disable groups 0 to 30."""
    group = int(model.actuator_group[i])
    return 0 <= group <= 30 and bool(int(model.opt.disableactuator) >> group & 1)


def _actuator(tree: Tree, control: Callable | None, i: int) -> list[AbstractForce]:
    model, name = tree.model, tree.name("actuator", i)
    joints, coefficients, zero = _transmission(tree, i)
    # actuators before it may have several controls and forces, if they are ignored
    at, own = int(model.actuator_ctrladr[i]), model.actuator_outadr[i]
    gear, gain = float(model.actuator_gear[own, 0]), float(model.actuator_gainprm[i, 0])
    affine = int(tree.mujoco.mjtBias.mjBIAS_AFFINE)
    bias = model.actuator_biasprm[i, :3] * (model.actuator_biastype[i] == affine)
    least, most = map(float, model.actuator_ctrlrange[at])
    is_clamped = model.actuator_ctrllimited[at] and not disabled(tree.mujoco, model, "CLAMPCTRL")
    limits = (least, most) if is_clamped else (-np.inf, np.inf)
    is_limited = bool(model.actuator_forcelimited[i])
    is_servo = bias[1] != 0 or bias[2] != 0
    if len(joints) > 1 or is_limited or is_servo:
        drive = _Drive(control, at, gain, limits, float(bias[0]))
        spring = dict(stiffness=-bias[1], rest=-gear * zero, damping=-bias[2])
        bounds = tuple(map(float, model.actuator_forcerange[i])) if is_limited else None
        return [_TENDON(joints, gear * coefficients, drive, **spring, limits=bounds, name=name)]
    joint = next(iter(joints))
    gear *= float(coefficients[0])
    constant = gear * float(bias[0])
    drive = _Drive(control, at, gear * gain, limits, constant)
    return [_MOTOR(joint, drive, name=name)]


def _transmission(tree: Tree, i: int) -> tuple[tuple[str, ...], np.ndarray, float]:
    """Return the joints of an actuator, the coefficients of its length, and this length in the drawing."""
    model, target = tree.model, int(tree.model.actuator_trnid[i, 0])
    if is_of_tendon(tree.mujoco, model, i):
        return _tendon(tree, target)
    zero = float(tree.drawing.qpos[model.jnt_qposadr[target]])
    return (tree.joint_of[target],), np.ones(1), zero


def _tendon(tree: Tree, k: int) -> tuple[tuple[str, ...], np.ndarray, float]:
    """Return the joints of a fixed tendon, its coefficients, and its length in the drawing."""
    model = tree.model
    own = slice(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k])
    joints, coefficients = model.wrap_objid[own], np.array(model.wrap_prm[own])
    zero = float(coefficients @ tree.drawing.qpos[model.jnt_qposadr[joints]])
    return tuple(tree.joint_of[int(j)] for j in joints), coefficients, zero


def tendon_springs(tree: Tree) -> list[AbstractForce]:
    """Return the springs and dampers of fixed tendons, with other names than actuators have."""
    model, found = tree.model, []
    taken = {tree.name("actuator", i) for i in range(model.nactuator)}
    names = "tendon_stiffness", "tendon_damping"
    stiffnesses, dampings = (in_effect(tree.mujoco, model, name) for name in names)
    for k in range(model.ntendon):
        stiffness, damping = stiffnesses[k], dampings[k]
        if (stiffness == 0 and damping == 0) or tendon_fault(tree.mujoco, model, k):
            continue
        joints, coefficients, zero = _tendon(tree, k)
        spring = dict(
            stiffness=stiffness, rest=model.tendon_lengthspring[k, 0] - zero, damping=damping
        )
        name = tree.name("tendon", k)
        while name in taken:  # names of MuJoCo are unique among elements of one type alone
            name = f"tendon {name}"
        found.append(_TENDON(joints, coefficients, **spring, name=name))
    return found


class _Drive(AbstractBounded):
    """One control, within its limits, times a factor, plus a constant."""

    control: Callable | None
    index: int = eqx.field(static=True)
    factor: float = eqx.field(static=True)
    limits: tuple[float, float] = eqx.field(static=True)
    constant: float = eqx.field(static=True)

    @property
    def bounds(self) -> tuple[float, float]:
        given = np.zeros(2) if self.control is None else np.array([-np.inf, np.inf])
        values = self.factor * np.clip(given, *self.limits) + self.constant
        return float(values.min()), float(values.max())

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
