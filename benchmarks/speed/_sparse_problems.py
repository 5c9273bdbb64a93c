"""The problems of `sparse_stiff`: cells of two unknowns each, coupled with their neighbours."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj


class Problem(NamedTuple):
    """`mass * y' = rates(t, y, parameter, numpy)` with `y` of shape `(cells, 2)`.

    - `rates`: `numpy` is NumPy, JAX's or what names CasADi's functions like theirs.
    - `mass`: of the two columns, ones before zeros.
    - `slope0`: the derivative at the start, that of algebraic unknowns as well.
    - `jacobian`: rows, columns and entries of the derivative of `rates` by `y`, both flattened.
    - `explicit`: the first column's ODE where the second one has been eliminated by hand.
    """

    name: str
    rates: Callable
    mass: tuple[float, float]
    y0: np.ndarray
    slope0: np.ndarray
    parameter: float
    jacobian: Callable
    explicit: Callable | None

    @property
    def differential(self) -> int:
        return int(sum(self.mass))

    @property
    def terms(self) -> Any:
        rates = lambda t, y, a: self.rates(t, y, a, jnp)
        if self.differential == 2:
            return dfx.ODETerm(rates)
        return mj.MassMatrixTerm(rates, np.broadcast_to(self.mass, self.y0.shape))

    def residual(self, t: float, y: np.ndarray) -> float | None:
        """The largest residual of an algebraic equation, if there is one."""
        if self.differential == 2:
            return None
        return float(np.abs(self.rates(t, y, self.parameter, np)[:, 1]).max())


def brusselator(cells: int) -> Problem:
    scale = (cells + 1) ** 2

    def rates(t: Any, y: Any, a: Any, numpy: Any) -> Any:
        u, v = y[:, 0], y[:, 1]
        longer_u, longer_v = numpy.hstack([1.0, u, 1.0]), numpy.hstack([3.0, v, 3.0])
        rate_u = 1 + u * u * v - 4 * u + a * scale * (longer_u[2:] - 2 * u + longer_u[:-2])
        rate_v = 3 * u - u * u * v + a * scale * (longer_v[2:] - 2 * v + longer_v[:-2])
        return numpy.stack([rate_u, rate_v], axis=1)

    def jacobian(y: np.ndarray, a: float) -> list[tuple]:
        u, v = y[:, 0], y[:, 1]
        unknowns = np.arange(2 * cells)
        of_u, of_v = unknowns[::2], unknowns[1::2]
        neighbours = np.full(2 * cells - 2, a * scale)
        return [
            (of_u, of_u, 2 * u * v - 4 - 2 * a * scale),
            (of_u, of_v, u * u),
            (of_v, of_u, 3 - 2 * u * v),
            (of_v, of_v, -u * u - 2 * a * scale),
            (unknowns[2:], unknowns[:-2], neighbours),
            (unknowns[:-2], unknowns[2:], neighbours),
        ]

    x = np.linspace(0, 1, cells + 2)[1:-1]
    y0 = np.stack([1 + np.sin(2 * np.pi * x), 3 * np.ones(cells)], axis=1)
    slope0 = rates(0.0, y0, 0.02, np)
    return Problem("brusselator", rates, (1.0, 1.0), y0, slope0, 0.02, jacobian, None)


def ladder(cells: int) -> Problem:
    """Capacitors at voltages `v`, and between them nodes without one, at voltages `e`."""

    def charging(v: Any, e: Any, a: Any, numpy: Any) -> Any:
        right = numpy.hstack([e[1:], v[-1:]])
        return ((e - v) - (v - right) / a) / (1e-3 * (1 + v * v))

    def rates(t: Any, y: Any, a: Any, numpy: Any) -> Any:
        v, e = y[:, 0], y[:, 1]
        left = numpy.hstack([numpy.sin(3 * t), v[:-1]])
        return numpy.stack([charging(v, e, a, numpy), (left - e) / a - (e - v)], axis=1)

    def explicit(t: float, v: np.ndarray, a: float) -> np.ndarray:
        left = np.hstack([np.sin(3 * t), v[:-1]])
        return charging(v, (left / a + v) / (1 / a + 1), a, np)

    def jacobian(y: np.ndarray, a: float) -> list[tuple]:
        v, e = y[:, 0], y[:, 1]
        of_v, of_e = np.arange(0, 2 * cells, 2), np.arange(1, 2 * cells, 2)
        capacity, ones = 1e-3 * (1 + v * v), np.ones(cells)
        conductance = 1 + ones / a
        conductance[-1] = 1.0
        changing = -charging(v, e, a, np) * 2 * v / (1 + v * v)
        return [
            (of_v, of_v, changing - conductance / capacity),
            (of_v, of_e, 1 / capacity),
            (of_v[:-1], of_e[1:], 1 / (a * capacity[:-1])),
            (of_e, of_v, ones),
            (of_e, of_e, -ones - ones / a),
            (of_e[1:], of_v[:-1], ones[1:] / a),
        ]

    a, y0, slope0 = 0.5, np.zeros((cells, 2)), np.zeros((cells, 2))
    slope0[0, 1] = 3 / (1 + a)  # the only node beside the source, sin 3t
    return Problem("ladder", rates, (1.0, 0.0), y0, slope0, a, jacobian, explicit)
