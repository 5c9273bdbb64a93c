"""Rigid bodies with joints and forces, as a mechanical system."""

from .assembly import Assembly as Assembly
from .bodies import Body as Body, GROUND as GROUND, Pose as Pose
from .contacts import (
    GroundContact as GroundContact,
    JointFriction as JointFriction,
    JointStop as JointStop,
)
from .forces import (
    AbstractForce as AbstractForce,
    Controller as Controller,
    Damper as Damper,
    Force as Force,
    JointSpring as JointSpring,
    LinearActuator as LinearActuator,
    Motor as Motor,
    RotationalDamper as RotationalDamper,
    RotorInertia as RotorInertia,
    Spring as Spring,
    Tendon as Tendon,
    Torque as Torque,
)
from .joint_coordinates import JointCoordinates as JointCoordinates
from .joints import (
    AbstractJoint as AbstractJoint,
    Coupling as Coupling,
    Cylindrical as Cylindrical,
    Distance as Distance,
    Drive as Drive,
    Fixed as Fixed,
    Prismatic as Prismatic,
    Revolute as Revolute,
    Spherical as Spherical,
    Universal as Universal,
)
from .mujoco import from_mujoco as from_mujoco
from .mujoco_state import state_of_mujoco as state_of_mujoco
from .rotations import quaternion as quaternion
from .urdf import read_urdf as read_urdf, Robot as Robot
