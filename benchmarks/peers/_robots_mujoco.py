"""Robots of the collection in MuJoCo, where closed loops are soft constraints.

MuJoCo reads the URDF; its bodies are then put where the loops are closed, so that the drawing is `qpos0` as
here. Links without mass, which MuJoCo cannot move, lose their hinges to the link that follows.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np


STEPS = (1e-3, 1e-4)  # s
# Time constants of the loops in steps; 2 is the least that MuJoCo allows.
SOFTNESS = (2, 3, 5, 10, 20, 50, 100)


@dataclasses.dataclass(frozen=True)
class Swing:
    """Step and time constant of the loops (s), whether with the exact diagonal, largest gap (m), change of the
    energy over the largest kinetic energy, and seconds of the run."""

    step: float
    time_constant: float
    exact: bool
    gap: float
    energy: float
    run_s: float


class Soft:
    """A robot in MuJoCo at its drawing, with springs in its motors."""

    def __init__(self, urdf: Path, closures: dict[str, Any], robot: Any, stiffness: float):
        import mujoco

        self.mujoco = mujoco
        tree: Any = ElementTree.parse(urdf).getroot()
        for link in tree.findall("link"):  # their meshes are not needed
            for element in link.findall("visual") + link.findall("collision"):
                link.remove(element)
        option = ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler")
        option.attrib |= dict(fusestatic="false", balanceinertia="false")
        self.spec: Any = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"))
        self.joints: dict[str, Any] = {
            joint.find("child").get("link"): joint for joint in tree.findall("joint")
        }
        self.types = dict(
            zip(closures.get("joint_name", ()), closures.get("joint_type", ()), strict=True)
        )
        for link in self.joints:
            self._place(link, robot.frames)
        for joint in self.spec.joints:
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            if joint.name in robot.motors:
                joint.stiffness = [stiffness, 0, 0]
        kinds = (kind.lower() == "6d" for kind in closures["type"])
        self.loops = [
            self._close(pair, weld)
            for pair, weld in zip(closures["closed_loop"], kinds, strict=True)
        ]
        self._set_options()

    def _place(self, link: str, frames: dict[str, Any]) -> None:
        """Put a link where it is in the drawing, with the joints that move it."""
        body = self.spec.body(link)
        if link not in frames:
            body.pos, body.quat = np.zeros(3), [1, 0, 0, 0]
            return
        chain = [self.joints[link]]
        while (parent := chain[0].find("parent").get("link")) not in frames:
            chain.insert(0, self.joints[parent])
        inside = np.array(frames[parent].rotation).T
        turn = inside @ np.array(frames[link].rotation)
        body.pos = inside @ (np.array(frames[link].at) - np.array(frames[parent].at))
        body.quat = self._quaternion(turn)
        types = [self.types.get(joint.get("name")) for joint in chain]
        moving = [joint for joint in chain if joint.get("type") != "fixed"]
        if len(chain) == 1 and types[0] is None:
            return
        ends = [self.spec.body(joint.find("child").get("link")) for joint in chain]
        for end in ends:
            for joint in list(end.joints):
                self.spec.delete(joint)
        self._add(body, moving, types, turn)

    def _add(self, body: Any, moving: list[Any], types: Sequence[str | None], turn: Any) -> None:
        """Give the joints of a chain to its last link: the first axis is fixed in the link before."""
        kinds, name = self.mujoco.mjtJoint, moving[0].get("name")
        own = dict(zip("XYZ", np.eye(3), strict=True))
        kind = types[0]
        if kind == "FIXED":
            return
        if kind == "SPHERICAL" or len(moving) == 3:
            body.add_joint(name=name, type=kinds.mjJNT_BALL)
            return
        first, last = self._axis(moving[0]), self._axis(moving[-1])
        if kind is not None:
            first, last = (own[letter] for letter in kind.removeprefix("UJOINT_"))
        before = turn.T @ self._rotation(moving[0].find("origin").get("rpy")) @ first
        body.add_joint(name=name, type=kinds.mjJNT_HINGE, axis=before)
        body.add_joint(name=f"{name} second", type=kinds.mjJNT_HINGE, axis=last)

    def _axis(self, joint: Any) -> np.ndarray:
        return np.array([float(x) for x in joint.find("axis").get("xyz").split()])

    def _rotation(self, angles: str) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("xyz", [float(x) for x in angles.split()]).as_matrix()

    def _quaternion(self, matrix: np.ndarray) -> np.ndarray:
        quaternion = np.zeros(4)
        self.mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix).reshape(-1))
        return quaternion

    def _close(self, pair: Sequence[str], weld: bool) -> tuple[str, str]:
        child = {joint.get("name"): link for link, joint in self.joints.items()}
        first, second = (child.get(name, name) for name in pair)  # frames of links, or of joints
        kinds = self.mujoco.mjtEq
        self.spec.add_equality(
            type=kinds.mjEQ_WELD if weld else kinds.mjEQ_CONNECT,
            objtype=self.mujoco.mjtObj.mjOBJ_BODY,
            name1=first,
            name2=second,
            solimp=[0.9999, 0.9999, 0.001, 0.5, 2],
            data=[0] * 10 + [1, 0],  # at the origins of the frames, whose default is elsewhere
        )
        return first, second

    def _set_options(self) -> None:
        flags = self.mujoco
        option = self.spec.option
        option.integrator = flags.mjtIntegrator.mjINT_RK4
        option.solver, option.iterations = flags.mjtSolver.mjSOL_NEWTON, 100
        option.tolerance, option.gravity = 1e-14, [0, 0, -9.81]
        option.jacobian = flags.mjtJacobian.mjJAC_DENSE  # for `efc_J` as a matrix
        option.enableflags |= int(flags.mjtEnableBit.mjENBL_ENERGY)
        option.disableflags |= int(flags.mjtDisableBit.mjDSBL_AUTORESET)

    def model(self, step: float, softness: float, exact: bool = True) -> Any:
        """With the exact diagonal of the masses that loops feel, or MuJoCo's usual estimate."""
        bit, option = int(self.mujoco.mjtEnableBit.mjENBL_DIAGEXACT), self.spec.option
        option.enableflags = option.enableflags | bit if exact else option.enableflags & ~bit
        option.timestep = step
        for equality in self.spec.equalities:
            equality.solref = [softness * step, 1]
        return self.spec.compile()

    def accelerations(self, robot: Any) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return a program for one evaluation, and accelerations (m/s^2) of the bodies at rest in the drawing:
        MuJoCo's, and those of its masses and forces when the loops, as it linearizes them, are held exactly."""
        mujoco, model = self.mujoco, self.model(STEPS[0], SOFTNESS[0])
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        size, number = model.nv, data.ne
        M, J = np.zeros((size, size)), np.array(data.efc_J).reshape(-1, size)[:number]
        mujoco.mj_fullM(model, data, M)
        system = np.block([[M, J.T], [J, np.zeros((number, number))]])
        right = np.concatenate([data.qfrc_passive - data.qfrc_bias, np.zeros(number)])
        held = np.linalg.lstsq(system, right, rcond=1e-13)[0][:size]
        bodies, found = robot.assembly, []
        for name, center in zip(
            bodies.names, np.asarray(bodies.bodies.drawing.position), strict=True
        ):
            rows = np.zeros((3, size))
            mujoco.mj_jac(model, data, rows, None, center, data.body(name).id)
            found.append((rows @ data.qacc, rows @ held))
        soft, exact = np.moveaxis(np.array(found), 1, 0)
        return lambda: mujoco.mj_forward(model, data), soft, exact

    def swing(self, seconds: float, step: float) -> Swing | None:
        """Return the run with the smallest gap of those with the stiffest loops that stay finite, with both
        diagonals; `None` if there is none."""
        found = []
        for exact in (True, False):
            runs = (self._swing(seconds, step, softness, exact) for softness in SOFTNESS)
            found += [run] if (run := next(filter(None, runs), None)) else []
        return min(found, key=lambda run: run.gap, default=None)

    def _swing(self, seconds: float, step: float, softness: float, exact: bool) -> Swing | None:
        mujoco, model = self.mujoco, self.model(step, softness, exact)
        data = mujoco.MjData(model)
        ends = np.array([[data.body(name).id for name in pair] for pair in self.loops])
        mujoco.mj_forward(model, data)
        start, gap, change, kinetic = float(np.sum(data.energy)), 0.0, 0.0, 0.0
        begin = time.perf_counter()
        for _ in range(round(seconds / step)):
            mujoco.mj_step(model, data)
            apart = data.xpos[ends[:, 0]] - data.xpos[ends[:, 1]]
            gap = max(gap, float(np.linalg.norm(apart, axis=1).max()))
            change = max(change, abs(float(np.sum(data.energy)) - start))
            kinetic = max(kinetic, float(data.energy[1]))
            if not np.isfinite(data.energy).all():
                return None
        run = time.perf_counter() - begin
        return Swing(step, softness * step, exact, gap, change / kinetic, run)
