"""The drawing of a MuJoCo model: its reference pose, with coupled joints where their couplings have them."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from .mujoco_model import disabled, Index, name_of


_MET = 1e-12
_STEPS = 50


def drawing_of(mujoco: Any, model: Any) -> Any:
    """Return MuJoCo's data in `qpos0`, but with coupled joints where their couplings have them."""
    drawing, found = mujoco.MjData(model), list(active_couplings(mujoco, model))
    equations = [_Equation.of(model, *coupling) for coupling in found]
    with np.errstate(all="ignore"):  # of steps that lead nowhere
        x = _swept(equations, model.nq)
        x = _nearest(equations, model.nq) if x is None else x
    if x is None:
        names = [name_of(mujoco, model, "equality", e) for e, *_ in found]
        raise ValueError(
            f"The couplings of joints {names[:12]} contradict each other: no positions near `qpos0` satisfy all of them."
        )
    drawing.qpos[:] = model.qpos0 + x
    mujoco.mj_kinematics(model, drawing)
    mujoco.mj_comPos(model, drawing)
    return drawing


class _Equation(NamedTuple):
    """The equation `x = p(z)` of a coupling for two entries of `qpos`, counted from `qpos0`; without a second one `z` is
    zero."""

    joint: int
    other: int | None
    polynomial: Polynomial

    @staticmethod
    def of(model: Any, e: int, first: int, second: int) -> "_Equation":
        other = None if second < 0 else int(model.jnt_qposadr[second])
        return _Equation(int(model.jnt_qposadr[first]), other, Polynomial(model.eq_data[e, :5]))

    def value(self, x: np.ndarray) -> float:
        return float(self.polynomial(0.0 if self.other is None else x[self.other]))

    def row(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives of `x - p(z)`."""
        found = np.zeros(x.size)
        found[self.joint] = 1
        if self.other is not None:
            found[self.other] -= self.polynomial.deriv()(x[self.other])
        return found


def _swept(equations: Sequence[_Equation], size: int) -> np.ndarray | None:
    """Return positions where every joint is moved to where the other one has it, if no two equations move one."""
    x = np.zeros(size)
    for _ in range(len(equations) + 1):
        gaps = [0.0]
        for equation in equations:
            value = equation.value(x)
            gaps.append(abs(value - x[equation.joint]))
            x[equation.joint] = value
        if max(gaps) < _MET:
            return x
    return None


def _nearest(equations: Sequence[_Equation], size: int) -> np.ndarray | None:
    """Return positions that Newton steps of least norm from `qpos0` lead to, if they do."""
    x = np.zeros(size)
    for _ in range(_STEPS):
        gaps = np.array([x[equation.joint] - equation.value(x) for equation in equations])
        if not np.all(np.isfinite(gaps)):
            return None
        if np.abs(gaps).max() < _MET:
            return x
        rows = np.stack([equation.row(x) for equation in equations])
        x = x - np.linalg.lstsq(rows, gaps, rcond=1e-10)[0]
    return None


def active_couplings(mujoco: Any, model: Any) -> Iterator[tuple[int, int, int]]:
    """Return the equalities of joints that are active, and their joints; the second is -1 for none."""
    number = 0 if disabled(mujoco, model, "EQUALITY") else model.neq
    for e in range(number):
        if model.eq_active0[e] and int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT):
            yield e, int(model.eq_obj1id[e]), int(model.eq_obj2id[e])


def coefficients_of(model: Any, drawing: Any, e: Index, second: int) -> list[float]:
    """Return the coefficients of a coupling for coordinates that are zero in the drawing."""
    moved = Polynomial([_from_reference(model, drawing, second), 1.0])
    polynomial = Polynomial(model.eq_data[e, :5])(moved)
    return (polynomial.trim().coef[1:] if polynomial.trim().degree() else np.zeros(1)).tolist()


def _from_reference(model: Any, drawing: Any, joint: int) -> float:
    at = model.jnt_qposadr[joint]
    return float(drawing.qpos[at] - model.qpos0[at])
