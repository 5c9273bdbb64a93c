"""Configurations of a MuJoCo model: the drawing of its assembly, and the states of this for those of the model."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from .assembly import Assembly
from .bodies import Pose
from .checks import floating
from .mujoco_model import disabled, import_mujoco, Index, name_of
from .rotations import quaternion_rate


_MET = 1e-12


def drawing_of(mujoco: Any, model: Any) -> Any:
    """Return MuJoCo's data in `qpos0`, but with coupled joints where their couplings have them."""
    drawing = mujoco.MjData(model)
    couplings = list(active_couplings(mujoco, model))
    for _ in range(len(couplings) + 1):
        gaps = [0.0]
        for e, first, second in couplings:
            at = model.jnt_qposadr[first]
            z = 0.0 if second < 0 else _from_reference(model, drawing, second)
            value = model.qpos0[at] + np.polynomial.Polynomial(model.eq_data[e, :5])(z)
            gaps.append(abs(value - drawing.qpos[at]))
            drawing.qpos[at] = value
        if max(gaps) < _MET:
            mujoco.mj_kinematics(model, drawing)
            mujoco.mj_comPos(model, drawing)
            return drawing
    names = [name_of(mujoco, model, "equality", e) for e, *_ in couplings]
    raise ValueError(f"The couplings of joints {names[:12]} contradict each other in `qpos0`.")


def active_couplings(mujoco: Any, model: Any) -> Iterator[tuple[int, int, int]]:
    """Return the equalities of joints that are active, and their joints; the second is -1 for none."""
    number = 0 if disabled(mujoco, model, "EQUALITY") else model.neq
    for e in range(number):
        if model.eq_active0[e] and int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            yield e, int(model.eq_obj1id[e]), int(model.eq_obj2id[e])


def coefficients_of(model: Any, drawing: Any, e: Index, second: int) -> list[float]:
    """Return the coefficients of a coupling for coordinates that are zero in the drawing."""
    moved = np.polynomial.Polynomial([_from_reference(model, drawing, second), 1.0])
    polynomial = np.polynomial.Polynomial(model.eq_data[e, :5])(moved)
    return (polynomial.trim().coef[1:] if polynomial.trim().degree() else np.zeros(1)).tolist()


def _from_reference(model: Any, drawing: Any, joint: int) -> float:
    at = model.jnt_qposadr[joint]
    return float(drawing.qpos[at] - model.qpos0[at])


def link_names(mujoco: Any, model: Any, i: Index) -> list[str]:
    """Return the names of the links that the joints of a body move one after the other: the last is the body, the
    others have no mass."""
    body, start = name_of(mujoco, model, "body", i), model.body_jntadr[i]
    between = range(start, start + model.body_jntnum[i] - 1)
    return [*(f"{body} ({name_of(mujoco, model, 'joint', j)})" for j in between), body]


def state_of_mujoco(assembly: Assembly, model: Any, data: Any) -> tuple[Pose, Pose]:
    """Return the state `(q, v)` of an assembly of [`from_mujoco`][] for `qpos` and `qvel` in MuJoCo's
    `data`. Calls `mj_forward` on it. Poses do not tell whole turns: where `qpos` of a hinge is beyond `pi`, add multiples
    of `2 pi` to its number in [`JointCoordinates`][]."""
    mujoco = import_mujoco()
    mujoco.mj_forward(model, data)
    chains = [link_names(mujoco, model, i) for i in range(model.nbody)]
    known = {name: (i, k) for i, chain in enumerate(chains) for k, name in enumerate(chain)}
    rest, rows = drawing_of(mujoco, model), []
    for name in assembly.names:
        i, place = known[name]
        behind = len(chains[i]) - 1 - place  # joints between the link and the body
        moved = _without_last_joints(mujoco, model, data, rest, i, behind) if behind else data
        rows.append(_motion(mujoco, model, moved, i))
    x, p, moving, spins = (floating(np.stack(part)) for part in zip(*rows, strict=True))
    return Pose(x, p), Pose(moving, quaternion_rate(p, spins))


def _without_last_joints(mujoco: Any, model: Any, data: Any, rest: Any, i: int, number: int) -> Any:
    """Return data in which so many last joints of body `i` are at rest as in the drawing: it moves as the link
    before those joints."""
    moved = mujoco.MjData(model)
    moved.qpos[:], moved.qvel[:] = data.qpos, data.qvel
    end = model.body_jntadr[i] + model.body_jntnum[i]
    for j in range(end - number, end):
        of_positions = _entries(model.jnt_qposadr, j, model.nq)
        moved.qpos[of_positions] = rest.qpos[of_positions]
        moved.qvel[_entries(model.jnt_dofadr, j, model.nv)] = 0
    mujoco.mj_fwdPosition(model, moved)
    mujoco.mj_fwdVelocity(model, moved)
    return moved


def _entries(starts: Any, j: int, number: int) -> slice:
    return slice(starts[j], starts[j + 1] if j + 1 < len(starts) else number)


def _motion(mujoco: Any, model: Any, data: Any, i: int) -> tuple[np.ndarray, ...]:
    both = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, i, both, 0)
    orientation = quaternion_of(mujoco, data.ximat[i])
    return data.xipos[i].copy(), orientation, both[3:].copy(), both[:3].copy()


def quaternion_of(mujoco: Any, matrix: np.ndarray) -> np.ndarray:
    p = np.zeros(4)
    mujoco.mju_mat2Quat(p, np.ascontiguousarray(matrix).reshape(9))
    return p
