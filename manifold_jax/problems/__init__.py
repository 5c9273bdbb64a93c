"""The problem gallery: vector fields on manifolds whose solutions are known.

Every function builds a [`Problem`][]; its docstring has the equations, the source of every number and
the digits to trust. `ALL` has those that take seconds to compile, `FURTHER` the others: robots, those
that are there to be large, and those that have jumps.
"""

from collections.abc import Callable

from ._problem import Problem as Problem
from .battery import battery as battery
from .cable_net import cable_net as cable_net
from .car_axis import car_axis as car_axis
from .chain import chain as chain, double_pendulum as double_pendulum
from .compass_gait import compass_gait as compass_gait
from .delta_robot import delta_robot as delta_robot
from .falling_truss import falling_truss as falling_truss
from .four_bar import four_bar as four_bar
from .heavy_top import heavy_top as heavy_top
from .kepler import kepler as kepler
from .lotka_volterra import lotka_volterra as lotka_volterra
from .matrix_flows import rotation as rotation, sphere_flow as sphere_flow
from .n_four_bar import n_four_bar as n_four_bar
from .newtons_cradle import newtons_cradle as newtons_cradle
from .oscillator import harmonic_oscillator as harmonic_oscillator
from .parallelogram import parallelogram as parallelogram
from .pendulum import pendulum as pendulum, spherical_pendulum as spherical_pendulum
from .polymer import polymer as polymer
from .relay_feedback import relay_feedback as relay_feedback
from .rigid_body import rigid_body as rigid_body
from .rolling_disc import rolling_disc as rolling_disc
from .rotating_hoop import rotating_hoop as rotating_hoop
from .slider_crank import slider_crank as slider_crank
from .small_daes import arevalo as arevalo, jay2 as jay2, skate as skate
from .stewart_platform import stewart_platform as stewart_platform


def _named(*builds: Callable[[], Problem]) -> dict[str, Callable[[], Problem]]:
    return {build.__name__.replace("_", "-"): build for build in builds}


ALL = _named(
    harmonic_oscillator, pendulum, rigid_body, kepler, lotka_volterra, car_axis, jay2, arevalo, skate,
    sphere_flow, rotation, double_pendulum, chain, slider_crank, four_bar, parallelogram,
    spherical_pendulum, heavy_top, rolling_disc,
)  # fmt: skip
FURTHER = _named(
    compass_gait, newtons_cradle, rotating_hoop, relay_feedback, battery, delta_robot, stewart_platform, n_four_bar,
    cable_net, falling_truss, polymer,
)  # fmt: skip
