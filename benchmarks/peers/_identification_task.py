"""The task of `benchmarks.peers.identification`: a delta robot with motors, ten numbers of which are unknown.

The robot of the gallery, with viscous friction and the inertia of a rotor in each hinge, is moved for
two seconds by torques that are known. The position of its platform (to 0.1 mm) and the three angles
of its motors (to 0.5 mrad) are measured 200 times. Known besides: the radius of the platform, gravity,
and position and velocity of the platform at the start.
"""

import math
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj
from manifold_jax import multibody as mb
from manifold_jax.problems.delta_robot import DeltaRobotArgs


gallery = import_module("manifold_jax.problems.delta_robot")  # also of that name: its function
ARMS = 3
TS = np.linspace(0.01, 2.0, 200)
SIGMA = np.array([1e-4] * 3 + [5e-4] * ARMS)  # m, rad
# Of the motors' torques: N m, Hz.
AMPLITUDES, FREQUENCIES = (2.0, 1.6, 2.4), (1.3, 2.1, 3.1)
EXACT = 1e-11  # tolerance of the solve that the data are made from
PLATFORM_RADIUS, GRAVITY = 0.08, 9.81  # m, m/s^2
VELOCITY = np.array([0.6, 0.3, 0.0])  # of the platform at the start, m/s


class Unknowns(NamedTuple):
    """Masses of the platform and of each arm (kg), lengths of arms and rods and radius of the base
    (m), stiffness of the springs in the hinges (N m/rad), inertia of each rotor (kg m^2), and the
    friction of the three motors (N m s/rad)."""

    platform_mass: Any
    arm_mass: Any
    arm_length: Any
    rod_length: Any
    base_radius: Any
    stiffness: Any
    rotor_inertia: Any
    friction: Any


class Estimates(NamedTuple):
    """Of one fit: the ten values and their standard errors, the reduced chi squared, how many
    trajectories without derivatives and how many Jacobians were computed, and seconds."""

    values: np.ndarray
    errors: np.ndarray
    chi_squared: float
    trajectories: int
    jacobians: int
    seconds: float

    @property
    def away(self) -> np.ndarray:
        """Errors in units of the standard errors."""
        return (self.values - TRUE) / self.errors


NAMES = (*Unknowns._fields[:-1], *[f"friction[{i}]" for i in range(ARMS)])
TRUE = np.array([1.0, 0.5, 0.35, 0.8, 0.2, 8.0, 0.01, 0.05, 0.08, 0.11])
# 10 to 20 % off.
GUESS = TRUE * np.array([1.15, 0.82, 1.1, 0.9, 1.1, 0.85, 1.2, 0.8, 1.2, 0.85])


def unknowns(values: Any) -> Unknowns:
    return Unknowns(*values[:-ARMS], values[-ARMS:])


def of_gallery(given: Unknowns) -> DeltaRobotArgs:
    """The arguments of the robot without friction, rotors and motors."""
    same = given._asdict()
    del same["rotor_inertia"], same["friction"]
    return DeltaRobotArgs(**same, platform_radius=PLATFORM_RADIUS, gravity=GRAVITY)


def torque(motor: int, xp: ModuleType, t: Any) -> Any:
    return AMPLITUDES[motor] * xp.sin(2 * math.pi * FREQUENCIES[motor] * t)


def assembly(given: Unknowns) -> mb.Assembly:
    """The gallery's robot with what else is in its hinges."""
    bodies, joints, _, gravity = gallery.parts(jax.tree.map(jnp.asarray, of_gallery(given)))
    forces = []
    for i, name in enumerate(gallery.ARMS):
        # The hinge is fixed in space, and its axis is the second of the arm.
        rotor = given.rotor_inertia * jnp.asarray([0.0, 1.0, 0.0])
        bodies[i] = eqx.tree_at(lambda b: b.inertia, bodies[i], bodies[i].inertia + rotor)
        hinge = f"hinge of {name}"
        forces.append(mb.JointSpring(hinge, given.stiffness, damping=given.friction[i]))
        forces.append(mb.Motor(hinge, lambda t, args, i=i: torque(i, jnp, t)))
    return mb.Assembly(bodies, joints, forces, gravity=gravity)


SYSTEM = mb.parametrized(assembly)


def drawn_depth(args: Any) -> Any:
    """Of the platform below the hinges where the arms are horizontal."""
    across = args.base_radius + args.arm_length - args.platform_radius
    return (args.rod_length**2 - across**2) ** 0.5


def platform_at_start() -> np.ndarray:
    """Below the base, with horizontal arms."""
    return np.array([0.0, 0.0, -drawn_depth(of_gallery(unknowns(TRUE)))])


def arms_at_start(xp: ModuleType, given: Unknowns) -> tuple[Any, Any]:
    """Angles of the arms below the horizontal and their rates, which depend on the lengths."""
    args = jax.tree.map(xp.asarray, of_gallery(given))
    return gallery._arms(xp, xp.asarray(platform_at_start()), xp.asarray(VELOCITY), args)[:2]


def state_at_start(given: Unknowns) -> tuple[mb.Pose, mb.Pose]:
    args = jax.tree.map(jnp.asarray, of_gallery(given))
    platform = jnp.asarray(platform_at_start()), jnp.asarray(VELOCITY)
    return gallery._bodies(jnp, *platform, *arms_at_start(jnp, given), args)


def observe(t: Any, y: Any, parameters: Any) -> Any:
    """Position of the platform and angles of the motors, these from the quaternions of the arms."""
    half = np.array(gallery.DIRECTIONS) / 2
    c, s, turned = np.cos(half), np.sin(half), y[0].orientation[:ARMS]
    sines = c * turned[:, 2] - s * turned[:, 1]
    angles = 2 * jnp.arctan2(sines, c * turned[:, 0] + s * turned[:, 3])
    return jnp.concatenate([y[0].position[ARMS], angles])


@eqx.filter_jit
def predict(values: Any, tolerance: Any, solver: Any) -> Any:
    """What is measured at `TS`, `(200, 6)`, without noise."""
    given = unknowns(values)
    sol = mj.diffeqsolve(
        SYSTEM.terms,
        mj.Projected(solver, SYSTEM.constraint),
        0.0,
        TS[-1],
        None,
        state_at_start(given),
        given,
        saveat=dfx.SaveAt(ts=jnp.asarray(TS)),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance),
    )
    return jax.vmap(partial(observe, parameters=given))(jnp.asarray(TS), sol.ys)


def exact() -> np.ndarray:
    return np.asarray(predict(jnp.asarray(TRUE), jnp.asarray(EXACT), dfx.Dopri8()))


def measured(without_noise: np.ndarray, seed: int) -> np.ndarray:
    return without_noise + SIGMA * np.random.default_rng(seed).normal(size=without_noise.shape)
