"""Checks for elements of a MuJoCo model that an assembly does not support, by name."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .mujoco_model import disabled, in_effect, Index, limited_joints, name_of


# Attribute of the model, the kind of element its entries belong to, and the user's name for it. Any
# nonzero entry is refused, unless a flag switches it off.
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
    ("actuator_dampingpoly", "actuator", "actuator damping"),
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
    "sleep",
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
        if word in ignore or (word, name) in allowed or name in found.get(word, ()):
            continue
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
        entries = in_effect(mujoco, model, attribute)
        is_given = np.any(entries != 0, axis=tuple(range(1, entries.ndim)))
        for i in np.flatnonzero(is_given):
            yield word, name_of(mujoco, model, kind, i)
    for count, word in COUNTED:
        for i in range(getattr(model, count)):
            yield word, f"{word} {i}"
    yield from _forces_of_joints(mujoco, model)
    yield from _elements(mujoco, model)
    yield from _contacts(mujoco, model)
    if model.opt.density != 0 or model.opt.viscosity != 0:
        yield "fluid", "density and viscosity of option"
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        yield "sleep", "flag sleep"


def _with_one_coordinate(mujoco: Any, model: Any, joint: Index) -> bool:
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return int(model.jnt_type[joint]) in kinds


def _forces_of_joints(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    """Refuse springs, dampers and rotors of joints that have no single coordinate here."""
    ball = int(mujoco.mjtJoint.mjJNT_BALL)
    of_dofs, of_joints = (
        in_effect(mujoco, model, name) for name in ("dof_damping", "jnt_stiffness")
    )
    for joint in range(model.njnt):
        if _with_one_coordinate(mujoco, model, joint):
            continue
        name, own = name_of(mujoco, model, "joint", joint), model.dof_jntid == joint
        damping, armature = of_dofs[own], model.dof_armature[own]
        is_isotropic = int(model.jnt_type[joint]) == ball and np.ptp(damping) == 0
        if np.any(damping != 0) and not is_isotropic:
            yield "damping of several coordinates", name
        if np.any(armature != 0):
            yield "armature of several coordinates", name
        if of_joints[joint] != 0:
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
    if not _has_constant_gain(mujoco, model, i):
        return "actuator gain that is not constant"
    if int(model.actuator_dyntype[i]) != int(mujoco.mjtDyn.mjDYN_NONE):
        return "actuator dynamics"
    return None if int(model.actuator_biastype[i]) in biases else "actuator bias that is not affine"


def _has_constant_gain(mujoco: Any, model: Any, i: Index) -> bool:
    """Whether the force is its control times a number, also where that could depend on length and velocity."""
    is_flat = not np.any(model.actuator_gainprm[i, 1:3])
    kinds = {int(mujoco.mjtGain.mjGAIN_FIXED): True, int(mujoco.mjtGain.mjGAIN_AFFINE): is_flat}
    return kinds.get(int(model.actuator_gaintype[i]), False)


def is_of_tendon(mujoco: Any, model: Any, i: Index) -> bool:
    return int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON)


def tendon_fault(mujoco: Any, model: Any, k: Index) -> str | None:
    """Return the reason why a tendon is not supported, if there is one: it is fixed, and has a spring and a damper."""
    own = slice(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k])
    is_fixed = np.all(model.wrap_type[own] == int(mujoco.mjtWrap.mjWRAP_JOINT))
    value = lambda word: in_effect(mujoco, model, f"tendon_{word}")[k]
    has_slack = value("stiffness") != 0 and np.ptp(model.tendon_lengthspring[k]) != 0
    words = "limited", "frictionloss", "armature", "stiffnesspoly", "dampingpoly", "springyield"
    others = [np.any(value(word) != 0) for word in words]
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
    for e in range(0 if disabled(mujoco, model, "EQUALITY") else model.neq):
        fault = equality_fault(mujoco, model, e)
        if fault and model.eq_active0[e]:
            yield fault, name_of(mujoco, model, "equality", e)


def _contacts(mujoco: Any, model: Any) -> Iterator[tuple[str, str]]:
    """Return the geometries that may touch another; those of one body do not, nor those of a body and its moving
    parent, unless a flag says so."""
    if disabled(mujoco, model, "CONTACT"):
        return
    if model.npair > 0:
        yield "contact", "explicit pairs"
    welded, parents = model.body_weldid, model.body_parentid
    body, filtered = welded[model.geom_bodyid], not disabled(mujoco, model, "FILTERPARENT")
    for i in range(model.ngeom):
        touches = (model.geom_contype[i] & model.geom_conaffinity) | (
            model.geom_contype & model.geom_conaffinity[i]
        )
        a, b = body[i], body
        parent = (welded[parents[a]] == b) | (welded[parents[b]] == a)
        pair = np.sort(np.stack([model.geom_bodyid, 0 * b + model.geom_bodyid[i]]), axis=0)
        excluded = np.isin((pair[0] << 16) + pair[1], model.exclude_signature)
        related = excluded | (a == b) | (filtered & parent & (a != 0) & (b != 0))
        if np.any((touches != 0) & ~related):
            yield "contact", name_of(mujoco, model, "geom", i)
