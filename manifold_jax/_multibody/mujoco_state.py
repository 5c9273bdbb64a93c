"""States of an assembly for those of its MuJoCo model."""

from typing import Any

import numpy as np

from .assembly import Assembly
from .bodies import Pose
from .checks import floating
from .mujoco_drawing import drawing_of
from .mujoco_model import import_mujoco, Index, name_of
from .rotations import quaternion_rate


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
