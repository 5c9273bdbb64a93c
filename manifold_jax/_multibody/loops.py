"""Closed loops of a tree of links: the joint coordinates for which they are closed.

Source: Levenberg-Marquardt steps, Nocedal & Wright, Numerical Optimization (2006), sec. 10.3, for the
assembly analysis of Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), ch. 4.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from .kinematic_tree import KinematicTree
from .urdf_elements import Placement


_STARTS, _SPREAD = 20, 0.3
_STEPS = 200
_CLOSED = 1e-10  # largest gap of a closed loop: in m, or the difference of axes
_ROUNDING = 1e-15
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e6


class Closure(NamedTuple):
    """Two links whose frames coincide, or only their origins."""

    name: str
    first: str
    second: str
    is_rigid: bool


class _Part(NamedTuple):
    """Loops that share coordinates, and the equations `A x = b` of joints among them that mimic others."""

    closures: list[Closure]
    matrix: np.ndarray
    offset: np.ndarray
    free: np.ndarray  # the coordinates that may change


def close_loops(
    tree: KinematicTree, closures: Sequence[Closure], x: np.ndarray, held: Sequence[int]
) -> np.ndarray:
    """Return coordinates for which all loops are closed and that mimic others as they should, found from `x` or,
    where that fails, from starts beside it; those `held` stay."""
    free = np.setdiff1d(np.arange(tree.size), held)
    for part in _parts(tree, closures, free):
        x = _closed_from_starts(tree, part, free, x)
    _check_closed(tree, closures, x)
    is_alone = ~tree.mimics()[0].any(axis=0)
    return np.where(_is_free_angle(tree, free) & is_alone, (x + np.pi) % (2 * np.pi) - np.pi, x)


def _parts(tree: KinematicTree, closures: Sequence[Closure], free: np.ndarray) -> Iterator[_Part]:
    """Yield the loops that share free coordinates together: legs of a robot one after the other."""
    (matrix, offset), is_free = tree.mimics(), np.isin(np.arange(tree.size), free)
    uses = np.zeros((len(closures), tree.size), bool)
    for i, closure in enumerate(closures):
        uses[i, tree.ancestors(closure.first) + tree.ancestors(closure.second)] = True
    uses = np.concatenate([uses, matrix != 0]) & is_free
    number, part_of = connected_components(uses.astype(int) @ uses.T.astype(int), directed=False)
    of_loops, of_mimics = np.split(part_of, [len(closures)])
    for k in range(number):
        own = [closure for closure, part in zip(closures, of_loops, strict=True) if part == k]
        rows = of_mimics == k
        yield _Part(own, matrix[rows], offset[rows], np.flatnonzero(uses[part_of == k].any(axis=0)))


def _closed_from_starts(
    tree: KinematicTree, part: _Part, free: np.ndarray, x: np.ndarray
) -> np.ndarray:
    random, rest, found, trial = np.random.default_rng(0), tree.rest, [], x
    for _ in range(_STARTS):
        tree.rest = dict(rest)
        trial, gap = _descend(tree, part, trial.copy())
        found.append((np.abs(gap).max(initial=0), trial, tree.rest))
        if found[-1][0] <= _CLOSED:
            break
        trial = x.copy()
        spread = np.zeros(x.size)
        spread[free] = random.normal(scale=_SPREAD, size=free.size)
        trial[part.free] += spread[part.free]
    _, x, tree.rest = min(found, key=lambda one: one[0])
    return x


def _is_free_angle(tree: KinematicTree, free: np.ndarray) -> np.ndarray:
    turns = [motion.turns for joint in tree.order for motion in tree.motions[joint.name]]
    return np.array(turns, bool) & np.isin(np.arange(tree.size), free)


def _descend(tree: KinematicTree, part: _Part, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates where the gaps are least, and the gaps."""
    free, damping, (gap, J) = part.free, 1e-2, _gaps(tree, part, x)
    for _ in range(_STEPS):
        if np.abs(gap).max(initial=0) < _ROUNDING or damping > _MOST_DAMPING:
            break
        trial, own = x.copy(), J[:, free]
        trial[free] -= np.linalg.solve(own.T @ own + damping * np.eye(free.size), own.T @ gap)
        new_gap, _ = _gaps(tree, part, trial)
        if new_gap @ new_gap < gap @ gap:
            x, damping = trial, max(damping / 5, _LEAST_DAMPING)
            tree.turn_ball_joints(x)
            gap, J = _gaps(tree, part, x)
        else:
            damping *= 4
    return x, gap


def _gaps(tree: KinematicTree, part: _Part, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all gaps and their derivatives by the coordinates."""
    placed, axes = tree.place(x)
    gaps, rows = [part.matrix @ x - part.offset], [part.matrix]
    for closure in part.closures:
        gap = closure_gap(placed, closure)
        J = np.zeros((12, tree.size))
        for link, sign in ((closure.first, -1), (closure.second, 1)):
            rotation, origin = placed[link]
            for i in tree.ancestors(link):
                turns, axis, at = axes[i]
                J[:3, i] += sign * (np.cross(axis, origin - at) if turns else axis)
                J[3:, i] += sign * turns * np.cross(axis, rotation.T).reshape(-1)
        gaps.append(gap)
        rows.append(J[: gap.size])
    return np.concatenate(gaps), np.concatenate(rows)


def closure_gap(placed: Mapping[str, Placement], closure: Closure) -> np.ndarray:
    """Return the differences of the origins, and for a rigid closure those of the three axes."""
    first, second = placed[closure.first], placed[closure.second]
    gap = second.origin - first.origin
    if not closure.is_rigid:
        return gap
    return np.concatenate([gap, (second.rotation - first.rotation).T.reshape(-1)])


def _check_closed(tree: KinematicTree, closures: Sequence[Closure], x: np.ndarray) -> None:
    placed, _ = tree.place(x)
    matrix, offset = tree.mimics()
    if np.abs(matrix @ x - offset).max(initial=0) > _CLOSED:
        raise ValueError(
            "Joints cannot mimic others as `file` says. Check `configuration`, and <mimic> with loops in `closures`, or leave it "
            "out by `ignore=('mimic',)`."
        )
    sizes = [(np.abs(closure_gap(placed, closure)).max(), closure.name) for closure in closures]
    if open_ := sorted((pair for pair in sizes if not pair[0] <= _CLOSED), reverse=True):
        worst = ", ".join(f"{name} (gap {size:.3g})" for size, name in open_[:5])
        raise ValueError(
            f"The loops cannot be closed: {worst}, in m or of the axes. Check `closures`, lengths, and the joint coordinates in "
            "`configuration`, from which they are closed. Hinges that are not quite parallel cannot reach a weld, '6d', but close "
            "as ball joints, '3d'."
        )
