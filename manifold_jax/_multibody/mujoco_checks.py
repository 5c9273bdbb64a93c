"""Checks for elements of a MuJoCo model that an assembly does not support, by name."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np


Index = int | np.integer

# Attribute of the model, the kind of element its entries belong to, and the user's name for it. Any
# nonzero entry is refused. With the names of older and newer versions.
REFUSED = (
    ("jnt_limited", "joint", "joint limit"),
    ("jnt_actfrclimited", "joint", "actuator force limit"),
    ("jnt_stiffnesspoly", "joint", "nonlinear stiffness"),
    ("jnt_springyield", "joint", "plastic spring"),
    ("dof_frictionloss", "dof", "friction loss"),
    ("dof_dampingpoly", "dof", "nonlinear damping"),
    ("body_gravcomp", "body", "gravity compensation"),
    ("tendon_actfrclimited", "tendon", "actuator force limit"),
    ("actuator_armature", "actuator", "armature"),
    ("actuator_damping", "actuator", "actuator damping"),
    ("actuator_delay", "actuator", "actuator delay"),
)
COUNTED = (
    ("nflex", "flex"),
    ("nplugin", "plugin"),
    ("nmocap", "mocap body"),
)
OTHERS = (
    "contact",
    "tendon",
    "fluid",
    "disabled springs or dampers",
    "damping of several coordinates",
    "stiffness of several coordinates",
    "armature of several coordinates",
    "actuator that is not of a joint or fixed tendon",
    "actuator of several coordinates",
    "actuator gain that is not constant",
    "actuator dynamics",
    "actuator bias that is not affine",
    "equality of type ...",
)
HINT = "Remove them, or leave them out of the motion by `ignore=(...)` with some of {words}."


def import_mujoco() -> Any:
    try:
        import mujoco
    except ImportError:
        raise ImportError(
            'MJCF and URDF are read by MuJoCo: `pip install "manifold_jax[mjcf]"`.'
        ) from None
    return mujoco


def name_of(mujoco: Any, model: Any, kind: str, i: Index) -> str:
    """Return the name of an element; `"body 3"` for one without."""
    if kind == "dof":
        kind, i = "joint", model.dof_jntid[i]
    code = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    return mujoco.mj_id2name(model, code, int(i)) or f"{kind} {i}"


def limited_joints(mujoco: Any, model: Any) -> list[int]:
    """Return the hinges and slides with limits."""
    if disabled(mujoco, model, "LIMIT"):
        return []
    has_one_coordinate = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    return [int(j) for j in np.flatnonzero((model.jnt_limited != 0) & has_one_coordinate)]


def refuse_unsupported(
    mujoco: Any, model: Any, ignore: Sequence[str], has_stops: bool = False
) -> None:
    """Refuse what is not supported; limits of hinges and slides are with stops."""
    if isinstance(ignore, str):
        raise TypeError(f"`ignore` must be a sequence of words, write `ignore=({ignore!r},)`.")
    _check_words(ignore)
    found: dict[str, list[str]] = {}
    stopped = limited_joints(mujoco, model) if has_stops else []
    allowed = {("joint limit", name_of(mujoco, model, "joint", j)) for j in stopped}
    for word, name in _unsupported(mujoco, model):
        if word not in ignore and (word, name) not in allowed:
            found.setdefault(word, []).append(name)
    if found:
        listed = "; ".join(
            f"{word}: {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"
            for word, names in found.items()
        )
        words = ", ".join(map(repr, found))
        raise ValueError(
            f"The model has elements that are not supported: {listed}. {HINT.format(words=words)}"
        )


def _check_words(ignore: Sequence[str]) -> None:
    known = [*dict.fromkeys(entry[-1] for entry in (*REFUSED, *COUNTED)), *OTHERS]
    of_equality = "equality of type "
    supported = [of_equality + kind for kind in ("connect", "weld", "joint")]
    is_known = lambda word: word in known or word.startswith(of_equality)
    unknown = [word for word in ignore if not is_known(word) or word in supported]
    if unknown:
        raise ValueError(
            f"`ignore` has words that mean nothing here: {unknown}. Those that do are {', '.join(map(repr, known))}."
        )


def _unsupported(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    for attribute, kind, word in REFUSED:
        entries = np.asarray(getattr(model, attribute, np.zeros(0)))
        if attribute == "jnt_limited" and disabled(mujoco, model, "LIMIT"):
            continue
        if attribute == "dof_frictionloss" and disabled(mujoco, model, "FRICTIONLOSS"):
            continue
        rows = entries.reshape(entries.shape[0], -1) if entries.size else np.zeros((0, 1))
        for i in np.flatnonzero(np.any(rows != 0, axis=1)):
            yield word, name_of(mujoco, model, kind, i)
    for count, word in COUNTED:
        for i in range(getattr(model, count, 0)):
            yield word, f"{word} {i}"
    yield from _forces_of_joints(mujoco, model)
    yield from _elements(mujoco, model)
    yield from _contacts(mujoco, model)
    if model.opt.density != 0 or model.opt.viscosity != 0:
        yield "fluid", "density and viscosity of option"
    for flag, of_joints, of_tendons in (
        ("SPRING", model.jnt_stiffness, model.tendon_stiffness),
        ("DAMPER", model.dof_damping, model.tendon_damping),
    ):
        if disabled(mujoco, model, flag) and (np.any(of_joints != 0) or np.any(of_tendons != 0)):
            yield "disabled springs or dampers", f"flag {flag.lower()}"


def disabled(mujoco: Any, model: Any, flag: str) -> bool:
    bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0)
    return bool(model.opt.disableflags & int(bit))


def _with_one_coordinate(mujoco: Any, model: Any, joint: Index) -> bool:
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return int(model.jnt_type[joint]) in kinds


def _forces_of_joints(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    """Refuse springs, dampers and rotors of joints that have no single coordinate here."""
    ball = int(mujoco.mjtJoint.mjJNT_BALL)
    for joint in range(model.njnt):
        if _with_one_coordinate(mujoco, model, joint):
            continue
        name, own = name_of(mujoco, model, "joint", joint), model.dof_jntid == joint
        damping, armature = model.dof_damping[own], model.dof_armature[own]
        is_isotropic = int(model.jnt_type[joint]) == ball and np.ptp(damping) == 0
        if np.any(damping != 0) and not is_isotropic:
            yield "damping of several coordinates", name
        if np.any(armature != 0):
            yield "armature of several coordinates", name
        if model.jnt_stiffness[joint] != 0:
            yield "stiffness of several coordinates", name


def actuator_fault(mujoco: Any, model: Any, i: Index) -> str | None:
    """Return the reason why an actuator cannot be a motor in a joint or pull a tendon, if there is one."""
    on_joint = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
    if is_of_tendon(mujoco, model, i):
        if tendon_fault(mujoco, model, model.actuator_trnid[i, 0]):
            return "actuator that is not of a joint or fixed tendon"
    elif int(model.actuator_trntype[i]) not in on_joint:
        return "actuator that is not of a joint or fixed tendon"
    elif not _with_one_coordinate(mujoco, model, model.actuator_trnid[i, 0]):
        return "actuator of several coordinates"
    biases = {int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)}
    if int(model.actuator_gaintype[i]) != int(mujoco.mjtGain.mjGAIN_FIXED):
        return "actuator gain that is not constant"
    if int(model.actuator_dyntype[i]) != int(mujoco.mjtDyn.mjDYN_NONE):
        return "actuator dynamics"
    return None if int(model.actuator_biastype[i]) in biases else "actuator bias that is not affine"


def is_of_tendon(mujoco: Any, model: Any, i: Index) -> bool:
    return int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON)


def tendon_fault(mujoco: Any, model: Any, k: Index) -> str | None:
    """Return the reason why a tendon is not supported, if there is one: it is fixed, and has a spring and a damper."""
    own = slice(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k])
    is_fixed = np.all(model.wrap_type[own] == int(mujoco.mjtWrap.mjWRAP_JOINT))
    has_slack = model.tendon_stiffness[k] != 0 and np.ptp(model.tendon_lengthspring[k]) != 0
    others = [
        np.any(getattr(model, f"tendon_{word}", np.zeros(k + 1))[k] != 0)
        for word in (
            "limited",
            "frictionloss",
            "armature",
            "stiffnesspoly",
            "dampingpoly",
            "springyield",
        )
    ]
    return "tendon" if not is_fixed or has_slack or any(others) else None


def equality_fault(mujoco: Any, model: Any, e: Index) -> str | None:
    names = "CONNECT", "WELD", "JOINT"
    known = {int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in names}
    kind = int(model.eq_type[e])
    if kind in known:
        return None
    return f"equality of type {mujoco.mjtEq(kind).name.removeprefix('mjEQ_').lower()}"


def _elements(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    for i in range(model.nactuator):
        if fault := actuator_fault(mujoco, model, i):
            yield fault, name_of(mujoco, model, "actuator", i)
    for k in range(model.ntendon):
        if fault := tendon_fault(mujoco, model, k):
            yield fault, name_of(mujoco, model, "tendon", k)
    for e in range(model.neq):
        fault = equality_fault(mujoco, model, e)
        if fault and model.eq_active0[e]:
            yield fault, name_of(mujoco, model, "equality", e)


def _contacts(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    """Return the first geometry that may touch another; those of one body, and of a body and its moving
    parent, do not."""
    if disabled(mujoco, model, "CONTACT"):
        return
    if model.npair > 0:
        yield "contact", "explicit pairs"
    welded, parents = model.body_weldid, model.body_parentid
    body = welded[model.geom_bodyid]
    for i in range(model.ngeom):
        touches = (model.geom_contype[i] & model.geom_conaffinity) | (
            model.geom_contype & model.geom_conaffinity[i]
        )
        a, b = body[i], body
        parent = (welded[parents[a]] == b) | (welded[parents[b]] == a)
        pair = np.sort(np.stack([model.geom_bodyid, 0 * b + model.geom_bodyid[i]]), axis=0)
        excluded = np.isin((pair[0] << 16) + pair[1], model.exclude_signature)
        related = excluded | (a == b) | (parent & (a != 0) & (b != 0))
        if np.any((touches != 0) & ~related):
            yield "contact", name_of(mujoco, model, "geom", i)
