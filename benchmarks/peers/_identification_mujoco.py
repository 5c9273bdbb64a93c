"""The task of `benchmarks.peers.identification` for `mujoco.sysid` (`pip install "mujoco[sysid]"`).

The model is that of `mechanisms_mujoco`; a modifier of its `MjSpec` writes the unknowns into it, as
the package provides for. The pose at the start depends on lengths: a rollout function of our own computes it.
Torques are constant in a step, those of its middle, which is accurate to second order in the step.
"""

import io
import time
from typing import Any

import numpy as np

import manifold_jax as mj

from . import _identification_task as task
from .mechanisms_mujoco import delta_model


# Relative to the unknowns, which are scaled to 1: smaller steps meet the tolerance of the constraint
# solver, larger ones the curvature.
DIFFERENCE = 1e-6
STEP = 1e-6  # at which it stops: a fiftieth of the smallest standard error
# Columns of its state (the time, three hinges, the platform) with what is measured. Its sensors would be
# those of the beginning of each step, late by one: an error of first order.
SHOWN = [4, 5, 6, 1, 2, 3]


class WithMujoco:
    """Fits with steps of `h` seconds, and counts of rollouts and Jacobians."""

    def __init__(self, h: float):
        import mujoco
        from absl import logging
        from mujoco import sysid

        logging.set_verbosity(logging.ERROR)  # that there are no sensors
        self.mujoco, self.sysid, self.h = mujoco, sysid, h
        self.rollouts = self.jacobians = 0
        self.spec = self._spec()
        self.model = self.spec.compile()

    def __call__(self, data: np.ndarray, guess: np.ndarray) -> task.Estimates:
        begin, self.rollouts, self.jacobians = time.perf_counter(), 0, 0
        residual = self.residual(guess, data)
        found, result = self.sysid.optimize(
            self.parameters(guess),
            residual,
            verbose=False,
            max_iters=100,
            eps=DIFFERENCE,
            xtol=STEP,
            output=io.StringIO(),
        )
        ends, _, _ = residual(result.x, found)
        covariance, _ = self.sysid.calculate_intervals(ends, result.jac)
        squares = float(np.sum(np.concatenate(ends) ** 2))
        return task.Estimates(
            guess * result.x,
            guess * np.sqrt(np.diagonal(covariance)),
            squares / (data.size - guess.size),
            self.rollouts,
            self.jacobians,
            time.perf_counter() - begin,
        )

    def predict(self, values: np.ndarray) -> np.ndarray:
        """What is measured, without noise."""
        nothing = np.zeros((task.TS.size, task.SIGMA.size))
        ends, _, _ = self.residual(values, nothing)(np.ones(values.size), self.parameters(values))
        return ends[0].reshape(nothing.shape) * task.SIGMA

    def _spec(self) -> Any:
        problem = mj.problems.delta_robot()
        robot = task.gallery.assembly(problem.args)
        spec = self.mujoco.MjSpec.from_string(delta_model(problem, robot, self.h))
        spec.option.enableflags = 0  # the energy
        for i, name in enumerate(task.gallery.ARMS):
            hinge = spec.body(name).joints[0]
            hinge.name = f"hinge {i}"
            spec.add_actuator(
                name=f"motor {i}",
                target=hinge.name,
                trntype=self.mujoco.mjtTrn.mjTRN_JOINT,
            )
        return spec

    def write(self, spec: Any, values: np.ndarray) -> None:
        """Draw the robot with these numbers: arms horizontal."""
        given = task.unknowns(values)
        args = task.of_gallery(given)
        L, r, depth = args.arm_length, args.platform_radius, task.drawn_depth(args)
        spread = task.gallery.SPREAD * r
        for i, name in enumerate(task.gallery.ARMS):
            c, s = np.cos(task.gallery.DIRECTIONS[i]), np.sin(task.gallery.DIRECTIONS[i])
            radial, tangential = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
            arm, hinge = spec.body(name), spec.joint(f"hinge {i}")
            arm.pos = (args.base_radius + L / 2) * radial
            arm.mass = given.arm_mass
            arm.inertia = given.arm_mass * L**2 / 12 * np.array([0.01, 1.0, 1.0])
            hinge.pos, hinge.stiffness[0] = -L / 2 * radial, given.stiffness
            hinge.damping[0], hinge.armature = given.friction[i], given.rotor_inertia
            for k, side in ((2 * i, 1), (2 * i + 1, -1)):
                spec.site(f"elbow {k}").pos = L / 2 * radial + side * spread * tangential
        platform = spec.body("platform")
        platform.pos, platform.mass = [0.0, 0.0, -depth], given.platform_mass
        platform.inertia = given.platform_mass * r**2 / 4 * np.array([1.0, 1.0, 2.0])

    def state(self, values: np.ndarray) -> np.ndarray:
        angle, rate = task.arms_at_start(np, task.unknowns(values))
        still = np.zeros(3)
        qpos = np.concatenate([angle, task.platform_at_start(), [1.0], still])
        qvel = np.concatenate([rate, task.VELOCITY, still])
        return self.sysid.create_initial_state(self.model, qpos, qvel)

    def parameters(self, guess: np.ndarray) -> Any:
        """One vector in units of the guess, so that steps and differences are relative."""
        one = np.ones_like(guess)
        modifier = lambda spec, parameter: self.write(spec, guess * parameter.value)
        found = self.sysid.ParameterDict()
        found.add(self.sysid.Parameter("unknowns", one, 0.5 * one, 2 * one, modifier=modifier))
        return found

    def residual(self, guess: np.ndarray, data: np.ndarray) -> Any:
        """In units of the noise, as `mj.fit` takes it."""
        sysid, last = self.sysid, task.TS[-1]
        times = self.h * np.arange(round(last / self.h) + 1)
        torques = [task.torque(i, np, times + self.h / 2) for i in range(task.ARMS)]
        control = sysid.TimeSeries(times, np.stack(torques, axis=1))
        signals = {"positions": (sysid.SignalType.CustomObs, np.arange(data.shape[1]))}
        measured = sysid.TimeSeries(task.TS, data, signals)
        start, name = self.state(guess), ("delta", self.spec, "motion")
        sequences = sysid.ModelSequences(
            *name, start, control, measured, allow_missing_sensors=True
        )

        def rollout(*, models: Any, param_dicts: Any, initial_states: Any, **given: Any) -> Any:
            self.rollouts += len(models)
            self.jacobians += len(models) > 1
            starts = [self.state(guess * values.as_vector()) for values in param_dicts]
            maps = {k: v for k, v in given.items() if k in ("datas", "control_signal")}
            return sysid.sysid_rollout(models=models, initial_states=starts, **maps)

        def compare(*given: Any, state: np.ndarray) -> Any:
            measured = given[2]
            found = sysid.TimeSeries(state[:, 0], state[:, SHOWN]).resample(task.TS).data
            same = sysid.TimeSeries(task.TS, found, measured.signal_mapping)
            return (found - measured.data) / task.SIGMA, same, measured

        return sysid.build_residual_fn(
            models_sequences=[sequences],
            custom_rollout=rollout,
            modify_residual=compare,
            resample_true=False,
            n_threads=1,
        )
