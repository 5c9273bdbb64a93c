"""The torques of a motion replayed in MuJoCo, where the loop is a soft constraint."""

from typing import Any

import numpy as np

from . import _five_bar as robot


STEP = 1e-4  # s


def model(theta: np.ndarray) -> str:
    """Return the robot in MJCF, at rest with these angles of its links."""
    left, right = theta[:2], theta[[3, 2]]
    arms = []
    for side, base, (first, second), (a, b) in (
        ("left", 0.0, robot.links()[:2], left),
        ("right", robot.BASE, robot.links()[:1:-1], right),
    ):
        inertial = lambda link: (
            f'<inertial pos="{link.center} 0 0" mass="{link.mass}" diaginertia="1e-2 1e-2 {link.inertia}"/>'
        )
        arms.append(f"""
          <body pos="{base} 0 0" euler="0 0 {a}">
            <joint name="{side}" axis="0 0 1" damping="{robot.FRICTION}"/>{inertial(first)}
            <body name="{side} rod" pos="{robot.PROXIMAL} 0 0" euler="0 0 {b - a}">
              <joint axis="0 0 1"/>{inertial(second)}
              <site name="{side} tool" pos="{robot.DISTAL} 0 0"/>
            </body>
          </body>""")
    return f"""
      <mujoco>
        <compiler angle="radian"/>
        <option timestep="{STEP}" integrator="RK4" gravity="0 {-robot.GRAVITY} 0" iterations="100" tolerance="1e-12"/>
        <worldbody>{"".join(arms)}</worldbody>
        <equality>
          <connect body1="left rod" body2="right rod" anchor="{robot.DISTAL} 0 0" solref="{2 * STEP} 1"/>
        </equality>
        <actuator><motor joint="left"/><motor joint="right"/></actuator>
      </mujoco>"""


def replay(theta: np.ndarray, ts: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, float]:
    """Return where the tool is at the end, and the largest gap of the loop (m)."""
    import mujoco

    own: Any = mujoco.MjModel.from_xml_string(model(theta))
    data = mujoco.MjData(own)
    largest = 0.0
    tools = [
        mujoco.mj_name2id(own, mujoco.mjtObj.mjOBJ_SITE, f"{s} tool") for s in ("left", "right")
    ]
    for k in range(round(ts[-1] / STEP)):
        data.ctrl[:] = [np.interp((k + 0.5) * STEP, ts, u) for u in inputs.T]
        mujoco.mj_step(own, data)
        mujoco.mj_kinematics(own, data)
        gap = data.site_xpos[tools[0]] - data.site_xpos[tools[1]]
        largest = max(largest, float(np.abs(gap).max()))
    return np.array(data.site_xpos[tools[0]][:2]), largest
