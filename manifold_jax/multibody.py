"""Rigid bodies with joints and forces, as a mechanical system: `mj.multibody`."""

from ._multibody import (
    AbstractForce as AbstractForce,
    AbstractJoint as AbstractJoint,
    Assembly as Assembly,
    Body as Body,
    Cylindrical as Cylindrical,
    Damper as Damper,
    Distance as Distance,
    Drive as Drive,
    Fixed as Fixed,
    Force as Force,
    from_mujoco as from_mujoco,
    GROUND as GROUND,
    JointSpring as JointSpring,
    LinearActuator as LinearActuator,
    Motor as Motor,
    Pose as Pose,
    Prismatic as Prismatic,
    quaternion as quaternion,
    Revolute as Revolute,
    Spherical as Spherical,
    Spring as Spring,
    state_of_mujoco as state_of_mujoco,
    Torque as Torque,
    Universal as Universal,
)
from ._multibody.parametrized import parametrized as parametrized
