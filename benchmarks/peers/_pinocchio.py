"""Accelerations of a robot with closed loops: its tree by Pinocchio, its loops by one linear system in NumPy.

An independent check: the tree has joint coordinates, nothing is welded together or left out, and chains
of hinges without mass stay hinges.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


class Tree:
    """The tree of a URDF and its closures."""

    def __init__(self, urdf: Path, closures: dict[str, Any]):
        import pinocchio as pin

        self.pin = pin
        self.model = pin.buildModelFromUrdf(str(urdf))  # pyright: ignore[reportAttributeAccessIssue]
        self.data = self.model.createData()
        frames, pairs = self.model.getFrameId, closures["closed_loop"]
        kinds = [6 if kind.lower() == "6d" else 3 for kind in closures["type"]]
        self.loops = [(frames(a), frames(b), n) for (a, b), n in zip(pairs, kinds, strict=True)]

    def coordinates(self, robot: Any) -> np.ndarray:
        """Return those of the robot's drawing. Angles of chains of hinges, which the robot has as ball joints,
        are found such that all frames are where the robot has them."""
        q, known = np.zeros(self.model.nq), []
        for name, value in robot.configuration.items():
            joint = self.model.joints[self.model.getJointId(name)]
            q[joint.idx_q] = value
            known.append(joint.idx_v)
        free = np.setdiff1d(np.arange(self.model.nv), known)
        random = np.random.default_rng(0)
        for _ in range(50):
            trial, gap = self._matched(q.copy(), free, robot.frames)
            if np.abs(gap).max(initial=0) < 1e-11:
                return trial
            q[free] = random.uniform(-3, 3, free.size)
        raise ValueError("The tree of Pinocchio could not be brought into the pose of the robot.")

    def _matched(
        self, q: np.ndarray, free: np.ndarray, frames: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Levenberg-Marquardt steps."""
        damping, (gap, J) = 1e-2, self._mismatch(q, frames)
        for _ in range(200 if free.size else 0):
            own, trial = J[:, free], q.copy()
            trial[free] -= np.linalg.solve(own.T @ own + damping * np.eye(free.size), own.T @ gap)
            new = self._mismatch(trial, frames)
            if new[0] @ new[0] < gap @ gap:
                q, (gap, J), damping = trial, new, max(damping / 5, 1e-12)
            else:
                damping *= 4
        return q, gap

    def _mismatch(self, q: np.ndarray, frames: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        self.pin.computeJointJacobians(self.model, self.data, q)
        self.pin.updateFramePlacements(self.model, self.data)
        gaps, rows = [], []
        for link, wanted in frames.items():
            number = self.model.getFrameId(link)
            placed, J = self.data.oMf[number], self._jacobian(number)
            axes = placed.rotation.T
            gaps += [placed.translation - wanted.at]
            gaps += [(axes - np.array(wanted.rotation).T).reshape(-1)]
            rows += [J[:3], *(np.cross(J[3:].T, axis).T for axis in axes)]
        return np.concatenate(gaps), np.concatenate(rows)

    def _jacobian(self, frame: int) -> np.ndarray:
        aligned = self.pin.LOCAL_WORLD_ALIGNED
        return self.pin.getFrameJacobian(self.model, self.data, frame, aligned)

    def loop_jacobian(self, q: np.ndarray) -> np.ndarray:
        self.pin.computeJointJacobians(self.model, self.data, q)
        self.pin.updateFramePlacements(self.model, self.data)
        return np.concatenate(
            [(self._jacobian(b) - self._jacobian(a))[:n] for a, b, n in self.loops]
        )

    def random_velocity(self, q: np.ndarray, seed: int) -> np.ndarray:
        """Return joint velocities with which all loops stay closed."""
        _, sizes, right = np.linalg.svd(self.loop_jacobian(q))
        rank = int(np.sum(sizes > 1e-9 * sizes[0]))
        return right[rank:].T @ np.random.default_rng(seed).normal(size=self.model.nv - rank)

    def accelerations(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Solve `M a + J^T z = -h`, `J a = -J' v`; of loops with too many equations the least `z`."""
        pin, model, data = self.pin, self.model, self.data
        upper = np.triu(pin.crba(model, data, q))
        M, h = upper + np.triu(upper, 1).T, pin.nonLinearEffects(model, data, q, v)
        J, still = self.loop_jacobian(q), np.zeros(model.nv)
        pin.forwardKinematics(model, data, q, v, still)
        pin.updateFramePlacements(model, data)
        bias = [(self._acceleration(b) - self._acceleration(a))[:n] for a, b, n in self.loops]
        system = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
        right = np.concatenate([-h, *(-part for part in bias)])
        return np.linalg.lstsq(system, right, rcond=1e-12)[0][: model.nv]

    def forward_dynamics(self, q: np.ndarray, v: np.ndarray) -> Callable[[], np.ndarray]:
        """Return a program for one evaluation by Pinocchio's own solver of closed loops."""
        pin, model, data = self.pin, self.model, self.data
        kinds, loops = {6: pin.ContactType.CONTACT_6D, 3: pin.ContactType.CONTACT_3D}, []
        for first, second, number in self.loops:
            sides = [model.frames[frame] for frame in (first, second)]
            ends = [part for side in sides for part in (side.parentJoint, side.placement)]
            loops.append(
                pin.RigidConstraintModel(kinds[number], model, *ends, pin.ReferenceFrame.LOCAL)
            )
        models, states = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        models.extend(loops)
        states.extend(loop.createData() for loop in loops)
        pin.initConstraintDynamics(model, data, models, states)
        none = np.zeros(model.nv)
        # Loops with more equations than needed have a singular system, which is solved in a few rounds.
        rounds = pin.ProximalSettings(1e-12, 1e-9, 20)
        return lambda: pin.constraintDynamics(model, data, q, v, none, models, states, rounds)

    def _acceleration(self, frame: int) -> np.ndarray:
        aligned = self.pin.LOCAL_WORLD_ALIGNED
        found = self.pin.getFrameClassicalAcceleration(self.model, self.data, frame, aligned)
        return found.vector

    def of_points(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, points: dict[str, np.ndarray]
    ) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return velocity, angular velocity and acceleration of a point of each link."""
        pin, model, data, found = self.pin, self.model, self.data, {}
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        for link, at in points.items():
            frame = model.getFrameId(link)
            arm = at - data.oMf[frame].translation
            moving = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            spin, change = moving.angular, self._acceleration(frame)
            velocity = moving.linear + np.cross(spin, arm)
            turning = np.cross(change[3:], arm) + np.cross(spin, np.cross(spin, arm))
            found[link] = velocity, spin, change[:3] + turning
        return found
