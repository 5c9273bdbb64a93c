"""A battery between its cut-off voltages: discharged, and charged again at constant current and voltage."""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from .._base.types import FloatScalar, RealScalarLike
from .._constraint.constraint import Constraint
from .._resets.reset import Reset
from ._problem import as_floating, integrate_with_resets, Problem, repeated


# What the battery is connected to.
LOAD, CONSTANT_CURRENT, CONSTANT_VOLTAGE = 0.0, 1.0, 2.0


class BatteryState(NamedTuple):
    """State of `battery`: the charge as a fraction of the capacity, voltages of the two RC elements (V), shape `(2,)`,
    current (A, positive where it charges) and mode (`LOAD`, `CONSTANT_CURRENT` or `CONSTANT_VOLTAGE`)."""

    charge: Any
    relaxation: Any
    current: Any
    mode: Any


class BatteryArgs(NamedTuple):
    """Parameters of `battery`: resistances (ohm) and capacitances (F) of the RC elements, shape `(2,)`, resistance in
    series (ohm), capacity (A h), currents of the load, of charging and where charging ends (A), lower and upper
    cut-off voltage (V)."""

    resistances: Any
    capacitances: Any
    series: Any = 0.07446
    capacity: Any = 0.85
    load: Any = 0.85
    charging: Any = 0.85
    final: Any = 0.0425
    lower: Any = 3.6
    upper: Any = 4.1


def open_circuit_voltage(xp: Any, charge: Any) -> Any:
    """Return the voltage without current for the charge as a fraction, with `xp` NumPy or `jax.numpy`."""
    polynomial = 3.685 + charge * (0.2156 + charge * (-0.1178 + 0.3201 * charge))
    return polynomial - 1.031 * xp.exp(-35 * charge)


def terminal_voltage(y: BatteryState, args: BatteryArgs) -> FloatScalar:
    """Return the voltage between the terminals."""
    inside = open_circuit_voltage(jnp, y.charge) + jnp.sum(y.relaxation)
    return inside + args.series * y.current


def _circuit(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> FloatScalar:
    """What the mode prescribes: the current, or the voltage."""
    prescribed = jnp.where(y.mode == LOAD, -args.load, args.charging)
    holds_voltage = y.mode == CONSTANT_VOLTAGE
    return jnp.where(holds_voltage, terminal_voltage(y, args) - args.upper, y.current - prescribed)


def _field(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> BatteryState:
    charging = y.current / (3600 * args.capacity)
    relaxing = (y.current - y.relaxation / args.resistances) / args.capacitances
    _, slope = jax.jvp(lambda s: open_circuit_voltage(jnp, s), (y.charge,), (charging,))
    at_voltage = -(slope + jnp.sum(relaxing)) / args.series
    still = jnp.zeros_like(y.current)
    changing = jnp.where(y.mode == CONSTANT_VOLTAGE, at_voltage, still)
    return BatteryState(charging, relaxing, changing, still)


def _in_mode(mode: float, y: BatteryState, value: FloatScalar) -> FloatScalar:
    return jnp.where(y.mode == mode, value, 1.0)


def _is_empty(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> FloatScalar:
    return _in_mode(LOAD, y, terminal_voltage(y, args) - args.lower)


def _is_high(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> FloatScalar:
    return _in_mode(CONSTANT_CURRENT, y, args.upper - terminal_voltage(y, args))


def _is_full(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> FloatScalar:
    return _in_mode(CONSTANT_VOLTAGE, y, y.current - args.final)


def _charge(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> BatteryState:
    current = jnp.full_like(y.current, args.charging)
    return y._replace(current=current, mode=jnp.full_like(y.mode, CONSTANT_CURRENT))


def _hold(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> BatteryState:
    return y._replace(mode=jnp.full_like(y.mode, CONSTANT_VOLTAGE))


def _discharge(t: RealScalarLike, y: BatteryState, args: BatteryArgs) -> BatteryState:
    current = jnp.full_like(y.current, -args.load)
    return y._replace(current=current, mode=jnp.full_like(y.mode, LOAD))


SWITCHES = (
    Reset(_is_empty, _charge, direction=False),
    Reset(_is_high, _hold, direction=False),
    Reset(_is_full, _discharge, direction=False),
)


def _initial_state(args: BatteryArgs, start: BatteryState) -> BatteryState:
    """Return the charge and the voltages of the RC elements of `start`, connected to the load."""
    return _discharge(0.0, start, args)


def _exact(t: np.ndarray, args: BatteryArgs, y0: Any) -> BatteryState:
    """Integrate charge and voltages of the RC elements, with the current from the equation of the mode."""
    R, C, load, charging = args.resistances, args.capacitances, args.load, args.charging

    def inside(x: np.ndarray) -> Any:
        return open_circuit_voltage(np, x[..., 0]) + x[..., 1] + x[..., 2]

    def current(x: np.ndarray) -> Any:
        at_voltage = (args.upper - inside(x)) / args.series
        mode = x[..., 3]
        return np.where(
            mode == LOAD, -load, np.where(mode == CONSTANT_CURRENT, charging, at_voltage)
        )

    def field(t: float, x: np.ndarray) -> np.ndarray:
        i = current(x)
        relaxing = (i - x[1:3] / R) / C
        return np.array([i / (3600 * args.capacity), *relaxing, 0.0])

    def in_mode(mode: float, value: Any) -> Any:
        return lambda t, x: float(value(x)) if x[3] == mode else 1.0

    voltage = lambda x: inside(x) + args.series * current(x)
    conditions = [
        in_mode(LOAD, lambda x: voltage(x) - args.lower),
        in_mode(CONSTANT_CURRENT, lambda x: args.upper - voltage(x)),
        in_mode(CONSTANT_VOLTAGE, lambda x: current(x) - args.final),
    ]
    following = [CONSTANT_CURRENT, CONSTANT_VOLTAGE, LOAD]
    start = np.array([y0.charge, *y0.relaxation, y0.mode])
    jump = lambda i, x: np.array([*x[:3], following[i]])
    x = integrate_with_resets(field, start, t, conditions, jump)
    return BatteryState(x[:, 0], x[:, 1:3], current(x), x[:, 3])


def battery(
    *,
    resistances: Any = (0.04669, 0.04984),
    capacitances: Any = (703.6, 4475.0),
    series: Any = 0.07446,
    capacity: Any = 0.85,
    load: Any = 0.85,
    charging: Any = 0.85,
    final: Any = 0.0425,
    lower: Any = 3.6,
    upper: Any = 4.1,
    charge: Any = 1.0,
    t1: float = 9000.0,
) -> Problem:
    r"""A battery between its cut-off voltages, an equivalent circuit with two RC elements. With the charge s as a
    fraction of the capacity Q, the voltages $u_k$ of the RC elements and the current i,

    $$s' = i / Q, \qquad u_k' = (i - u_k / R_k) / C_k, \qquad v = v_0(s) + u_1 + u_2 + R_0 i.$$

    The equation for i, the constraint, depends on the mode: the current of a load until the voltage v falls to
    the lower cut-off; then a constant charging current until the voltage has the upper one; then this voltage until
    the current has fallen to the final one; then the load again. These switches are `resets` of the
    problem, and the mode is in the state, a named tuple `BatteryState(charge, relaxation, current, mode)`.

    ```python
    problem = mj.problems.battery()
    solver = mj.Projected(dfx.Tsit5(), problem.constraint)
    sol = mj.diffeqsolve(
        problem.terms, solver, 0.0, problem.t1, None, problem.y0, problem.args,
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9), resets=problem.resets,
    )
    run_time = sol.resets.times[0]
    ```

    Under the load $u_k = -R_k I (1 - e^{-t / R_k C_k})$ and $s = s_0 - I t / Q$ from a rested start, so that the run time is
    the root of one equation. The solution is an independent integration without i (SciPy's DOP853),
    restarted at the switches; to about 1e-10.

    **Arguments:**

    - `resistances` R (ohm), `capacitances` C (F), of shape `(2,)`, `series` R_0 (ohm), `capacity` Q (A h), `load`, `charging`,
        `final` (A), `lower`, `upper` (V): `args`. `with_args` keeps the charge and the voltages of the RC elements.
    - `charge`: at the start, rested.
    - `t1`: the end of the time span (s).

    Source: Chen & Rincon-Mora, Accurate electrical battery model capable of predicting runtime and I-V
    performance, IEEE Trans. Energy Convers. 21 (2006) 504-511: a polymer lithium-ion cell of 850 mA h, with $v_0$ of
    their equation 2, and its resistances and capacitances as the constants that they are above a fifth of
    the charge.
    """
    pair = ", one for each RC element"
    resistances = repeated(resistances, 2, "resistances", pair)
    capacitances = repeated(capacitances, 2, "capacitances", pair)
    circuit = series, capacity, load, charging, final, lower, upper
    charge = as_floating(charge)
    zero = jnp.zeros_like(charge)
    return Problem(
        "battery",
        diffrax.ODETerm(_field),
        constraint=Constraint(_circuit),
        t1=t1,
        args=BatteryArgs(resistances, capacitances, *circuit),
        start=BatteryState(charge, jnp.zeros(2, charge.dtype), zero, zero),
        initial_state=_initial_state,
        resets=SWITCHES,
        exact=_exact,
    )
