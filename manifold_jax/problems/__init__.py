"""The problem gallery: vector fields on manifolds whose solutions are known.

Every function builds a [`Problem`][]; its docstring has the equations, the source of
every number and the digits to trust.
"""

from collections.abc import Callable

from ._problem import Problem as Problem
from .car_axis import car_axis as car_axis
from .kepler import kepler as kepler
from .lotka_volterra import lotka_volterra as lotka_volterra
from .matrix_flows import rotation as rotation, sphere_flow as sphere_flow
from .oscillator import harmonic_oscillator as harmonic_oscillator
from .pendulum import pendulum as pendulum
from .rigid_body import rigid_body as rigid_body
from .small_daes import arevalo as arevalo, jay2 as jay2, skate as skate


ALL: dict[str, Callable[[], Problem]] = {
    "harmonic-oscillator": harmonic_oscillator,
    "pendulum": pendulum,
    "rigid-body": rigid_body,
    "kepler": kepler,
    "lotka-volterra": lotka_volterra,
    "car-axis": car_axis,
    "jay2": jay2,
    "arevalo": arevalo,
    "skate": skate,
    "sphere-flow": sphere_flow,
    "rotation": rotation,
}
