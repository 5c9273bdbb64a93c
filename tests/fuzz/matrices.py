"""Random flows on matrix manifolds; see `_fuzz_families`."""

import dataclasses
from typing import Any, ClassVar

import numpy as np
import scipy.linalg

from .families import Family, modulation, since_start


GROUPS = ("orthogonal", "lorentz", "special")


@dataclasses.dataclass(frozen=True)
class MatrixGroup(Family):
    """`X' = X A(t, X)` with `A` in the Lie algebra of a group of `rows` x `rows` matrices:
    `X^T K X = K` with `K` the identity or diag(-1, 1, ...), or `det X = 1`."""

    rows: int
    group: str
    span: ClassVar = 1.5
    parameters: ClassVar = ("constant", "swinging", "feedback")

    @property
    def n(self) -> int:
        return self.rows**2

    @property
    def m(self) -> int:
        return 1 if self.group == "special" else self.rows * (self.rows + 1) // 2

    def draw(self, rng, draws):
        k = self.rows
        names = ("constant", "swinging", "feedback", "weights")
        args = {name: 0.7 * rng.normal(size=(draws, k, k)) / np.sqrt(k) for name in names}
        args["frequency"] = rng.uniform(0.5, 3.0, draws)
        start = self._algebra(np, 0.5 * rng.normal(size=(draws, k, k)) / np.sqrt(k))
        return args, scipy.linalg.expm(start).reshape(draws, self.n)

    def _metric(self) -> np.ndarray:
        signs = np.ones(self.rows)
        signs[0] = -1 if self.group == "lorentz" else 1
        return np.diag(signs)

    def _algebra(self, xp: Any, free: Any) -> Any:
        if self.group == "special":
            trace = xp.trace(free, axis1=-2, axis2=-1) / self.rows
            return free - trace[..., None, None] * np.eye(self.rows)
        return self._metric() @ (free - xp.swapaxes(free, -1, -2))

    def _matrix(self, y: Any) -> Any:
        return y.reshape(*y.shape[:-1], self.rows, self.rows)

    def field(self, xp, t, y, args):
        X = self._matrix(y)
        swing = xp.sin(args["frequency"][..., None] * since_start(xp, t, args))[..., None]
        answer = xp.tanh(xp.sum(args["weights"] * X, axis=(-1, -2)))[..., None, None]
        free = args["constant"] + swing * args["swinging"] + answer * args["feedback"]
        return modulation(xp, t, args) * (X @ self._algebra(xp, free)).reshape(y.shape)

    def residual(self, xp, t, y, args):
        X = self._matrix(y)
        if self.group == "special":
            return xp.linalg.det(X)[..., None] - 1
        K = self._metric()
        gap = xp.swapaxes(X, -1, -2) @ K @ X - K
        i, j = np.triu_indices(self.rows)
        return gap[..., i, j]


@dataclasses.dataclass(frozen=True)
class Frames(Family):
    """`Y' = Omega(t) Y` with `Omega` skew of rank 4: `columns` orthonormal vectors in `R^rows`."""

    rows: int
    columns: int
    parameters: ClassVar = ("left", "right")

    @property
    def n(self) -> int:
        return self.rows * self.columns

    @property
    def m(self) -> int:
        return self.columns * (self.columns + 1) // 2

    def draw(self, rng, draws):
        shape = (draws, self.rows, 2)
        args = {name: rng.normal(size=shape) / self.rows**0.5 for name in ("left", "right")}
        args["frequency"] = rng.uniform(0.5, 3.0, draws)
        frames, _ = np.linalg.qr(rng.normal(size=(draws, self.rows, self.columns)))
        return args, frames.reshape(draws, self.n)

    def _frame(self, y: Any) -> Any:
        return y.reshape(*y.shape[:-1], self.rows, self.columns)

    def field(self, xp, t, y, args):
        Y, u, v = self._frame(y), args["left"], args["right"]
        swing = 1 + xp.sin(args["frequency"][..., None] * since_start(xp, t, args))[..., None]
        transposed = lambda a: xp.swapaxes(a, -1, -2)
        turned = u @ (transposed(v) @ Y) - v @ (transposed(u) @ Y)
        return modulation(xp, t, args) * (swing * turned).reshape(y.shape)

    def residual(self, xp, t, y, args):
        Y = self._frame(y)
        gap = xp.swapaxes(Y, -1, -2) @ Y - np.eye(self.columns)
        i, j = np.triu_indices(self.columns)
        return gap[..., i, j]
