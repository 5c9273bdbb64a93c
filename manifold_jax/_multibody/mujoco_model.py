"""What a MuJoCo model says: the names of its elements, and what its flags leave of them."""

from typing import Any

import numpy as np


Index = int | np.integer

# Kinds of constraints, which one flag switches off together.
CONSTRAINTS = ("EQUALITY", "FRICTIONLOSS", "LIMIT", "CONTACT")
# The flags that switch off what attributes of the model describe.
SWITCHES = {
    "jnt_limited": "LIMIT",
    "tendon_limited": "LIMIT",
    "dof_frictionloss": "FRICTIONLOSS",
    "tendon_frictionloss": "FRICTIONLOSS",
    "jnt_stiffness": "SPRING",
    "jnt_stiffnesspoly": "SPRING",
    "jnt_springyield": "SPRING",
    "tendon_stiffness": "SPRING",
    "tendon_stiffnesspoly": "SPRING",
    "tendon_springyield": "SPRING",
    "dof_damping": "DAMPER",
    "dof_dampingpoly": "DAMPER",
    "tendon_damping": "DAMPER",
    "tendon_dampingpoly": "DAMPER",
    "actuator_damping": "DAMPER",
    "actuator_dampingpoly": "DAMPER",
}


def import_mujoco() -> Any:
    try:
        import mujoco
    except ImportError:
        raise ImportError(
            'MJCF and URDF are read by MuJoCo: `pip install "manifold_jax[mjcf]"`.'
        ) from None
    return mujoco


def name_of(mujoco: Any, model: Any, kind: str, i: Index) -> str:
    """Return the name of an element; `"body 3"` for one without, `"unnamed body 3"` if another one is called so."""
    if kind == "dof":
        kind, i = "joint", model.dof_jntid[i]
    code = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    if name := mujoco.mj_id2name(model, code, int(i)):
        return name
    name = f"{kind} {i}"
    while mujoco.mj_name2id(model, code, name) >= 0:
        name = f"unnamed {name}"
    return name


def limited_joints(mujoco: Any, model: Any) -> list[int]:
    """Return the hinges and slides with limits."""
    has_one_coordinate = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    is_limited = in_effect(mujoco, model, "jnt_limited") != 0
    return [int(j) for j in np.flatnonzero(is_limited & has_one_coordinate)]


def disabled(mujoco: Any, model: Any, flag: str) -> bool:
    flags = (flag, "CONSTRAINT") if flag in CONSTRAINTS else (flag,)
    bits = [int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in flags]
    return bool(model.opt.disableflags & sum(bits))


def in_effect(mujoco: Any, model: Any, attribute: str) -> np.ndarray:
    """Return an array of the model, zeros if a flag switches off what it describes."""
    values = getattr(model, attribute)
    flag = SWITCHES.get(attribute)
    return np.zeros_like(values) if flag and disabled(mujoco, model, flag) else values
