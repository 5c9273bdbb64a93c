"""Equality constraints of a MuJoCo model: couplings of joints, and joints that close loops."""

from collections.abc import Collection

import numpy as np

from .bodies import GROUND
from .joints import AbstractRestraint, Coupling, Drive, Fixed, Spherical
from .mujoco_checks import equality_fault
from .mujoco_drawing import coefficients_of
from .mujoco_model import disabled, Index
from .mujoco_tree import Tree


def equalities(tree: Tree, taken: Collection[str]) -> list[AbstractRestraint]:
    """Return the equality constraints that are active, with other names than those `taken` by joints."""
    mujoco, model, found = tree.mujoco, tree.model, []
    for e in range(0 if disabled(mujoco, model, "EQUALITY") else model.neq):
        if not model.eq_active0[e] or equality_fault(mujoco, model, e):
            continue
        name = tree.name("equality", e)
        while name in taken:  # names of MuJoCo are unique among elements of one type alone
            name = f"equality {name}"
        if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            found.append(_coupling(tree, e, name))
        elif not _is_void(tree, e):
            found.append(_closing_joint(tree, e, name))
    return found


def _is_void(tree: Tree, e: Index) -> bool:
    """Whether an equality constraint is of one body, or of two that do not move against each other."""
    first, second = _bodies(tree, e)
    of_one = tree.whole(first) == tree.whole(second)
    return bool(of_one or tree.model.body_weldid[first] == tree.model.body_weldid[second])


def _bodies(tree: Tree, e: Index) -> tuple[int, int]:
    model = tree.model
    first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
    if _is_of_sites(tree, e):
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, second


def _is_of_sites(tree: Tree, e: Index) -> bool:
    return int(tree.model.eq_objtype[e]) == int(tree.mujoco.mjtObj.mjOBJ_SITE)


def _closing_joint(tree: Tree, e: Index, name: str) -> AbstractRestraint:
    """Convert an equality constraint of two bodies or sites, each with a point in its frame: a connect keeps the
    points together, as does a weld without torques, a weld also the frames, which must coincide in the drawing."""
    model, drawing, mujoco = tree.model, tree.drawing, tree.mujoco
    data, bodies = model.eq_data[e], _bodies(tree, e)
    objects = model.eq_obj1id[e], model.eq_obj2id[e]
    is_weld = int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_WELD)
    local = (data[3:6], data[0:3]) if is_weld else (data[0:3], data[3:6])
    origins, frames, wanted = drawing.xpos, drawing.xmat, np.eye(3).ravel()
    if _is_of_sites(tree, e):
        local, origins, frames = np.zeros((2, 3)), drawing.site_xpos, drawing.site_xmat
    elif is_weld:
        mujoco.mju_quat2Mat(wanted, data[6:10])
    first, second = (frames[i].reshape(3, 3) for i in objects)
    one = origins[objects[0]] + first @ local[0]
    other = origins[objects[1]] + second @ local[1]
    ends, torque_scale = map(tree.body, bodies), data[10]
    if not is_weld or torque_scale == 0:
        points = _in_body(tree, bodies[0], one), _in_body(tree, bodies[1], other)
        return Spherical(*ends, points=points, name=name)
    turned = first.T @ second - wanted.reshape(3, 3)
    if max(np.abs(other - one).max(), np.abs(turned).max()) > 1e-6:
        raise ValueError(
            f"The weld {tree.name('equality', e)!r} holds its bodies in another pose than that of `qpos0`, which is not "
            "supported: give them in the file as they are welded."
        )
    return Fixed(*ends, at=other, name=name)


def _coupling(tree: Tree, e: Index, name: str) -> AbstractRestraint:
    first, second = int(tree.model.eq_obj1id[e]), int(tree.model.eq_obj2id[e])
    joint = tree.joint_of[first]
    if second < 0:
        return Drive(joint, 0.0, name=name)
    coefficients = coefficients_of(tree.model, tree.drawing, e, second)
    return Coupling(joint, tree.joint_of[second], coefficients, name=name)


def _in_body(tree: Tree, body: Index, point: np.ndarray) -> np.ndarray:
    """Return the point in our frame of the body, that of its inertia."""
    if tree.body(body) == GROUND:
        return point
    body = tree.whole(body)
    return tree.drawing.ximat[body].reshape(3, 3).T @ (point - tree.drawing.xipos[body])
