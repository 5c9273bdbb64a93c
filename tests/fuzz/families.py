"""Random vector fields that are tangent to random manifolds, in NumPy and in JAX alike.

Every function takes the array module `xp`, the times `t` of shape `(...)`, states `(..., n)` and
parameters with the same leading axes. With NumPy these are the draws, and nothing of the library
is involved; with JAX there are none.
"""

import abc
import dataclasses
from typing import Any, ClassVar

import numpy as np
import scipy.linalg


Args = dict[str, Any]
# Smallest over largest singular value of the Jacobian, rows of length one, where a draw may start.
REGULAR_START = 0.3


@dataclasses.dataclass(frozen=True)
class Family(abc.ABC):
    """A shape of problem.

    `span` is the length of a run, `parameters` the names of the arguments in which gradients are
    taken.
    """

    span: ClassVar[float] = 2.0
    parameters: ClassVar[tuple[str, ...]] = ()
    mechanical: ClassVar[bool] = False
    stiff: ClassVar[bool] = False
    # Whether the constraint is that `invariants` keep their values.
    conserves: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def n(self) -> int: ...

    @property
    @abc.abstractmethod
    def m(self) -> int: ...

    @abc.abstractmethod
    def draw(self, rng: np.random.Generator, draws: int) -> tuple[Args, np.ndarray]:
        """Parameters and starts on the manifold, with a leading axis of length `draws`."""

    @abc.abstractmethod
    def field(self, xp: Any, t: Any, y: Any, args: Args) -> Any: ...

    @abc.abstractmethod
    def residual(self, xp: Any, t: Any, y: Any, args: Args) -> Any: ...

    def settled(self, args: Args, y0: np.ndarray) -> Args:
        """Parameters that follow from others and the start, computed anew."""
        del y0
        return args

    def exact(self, t: Any, y0: np.ndarray, args: Args) -> np.ndarray | None:
        """The solution, where it is known."""
        del t, y0, args
        return None


def modulation(xp: Any, t: Any, args: Args) -> Any:
    """The factor of the tangent part of a field: `rate`, more after `jump_time`."""
    late = xp.where(t > args["jump_time"], args["jump"], 0.0 * args["jump"])
    return (args["rate"] * (1 + late))[..., None]


def since_start(xp: Any, t: Any, args: Args) -> Any:
    return xp.asarray(t - args["start"])[..., None]


def apply(xp: Any, matrix: Any, vector: Any) -> Any:
    return xp.einsum("...ij,...j->...i", matrix, vector)


def drive(xp: Any, t: Any, y: Any, args: Args) -> Any:
    """A smooth bounded field without any structure."""
    phase = xp.cos(args["drive_frequency"][..., None] * since_start(xp, t, args))
    return apply(xp, args["outer"], xp.tanh(apply(xp, args["inner"], y) + phase))


def draw_drive(rng: np.random.Generator, draws: int, n: int) -> Args:
    hidden = 3
    return {
        "inner": rng.normal(size=(draws, hidden, n)) / np.sqrt(n),
        "outer": rng.normal(size=(draws, n, hidden)) / np.sqrt(hidden),
        "drive_frequency": rng.uniform(0.5, 3.0, draws),
    }


def tangent_part(xp: Any, raw: Any, G: Any, rate: Any) -> Any:
    """`raw - G^+ (G raw + rate)`."""
    normal = xp.linalg.solve(G @ xp.swapaxes(G, -1, -2), (apply(xp, G, raw) + rate)[..., None])
    return raw - xp.einsum("...mi,...m->...i", G, normal[..., 0])


def conditions(G: np.ndarray) -> np.ndarray:
    """Smallest over largest singular value, after every row has been divided by its length."""
    lengths = np.linalg.norm(G, axis=-1, keepdims=True)
    values = np.linalg.svd(G / np.where(lengths > 0, lengths, 1), compute_uv=False)
    return np.where(np.all(lengths[..., 0] > 0, axis=-1), values[..., -1] / values[..., 0], 0)


@dataclasses.dataclass(frozen=True)
class Quadrics(Family):
    """`m` quadrics in general position, the first one an ellipsoid; `moving` in time."""

    size: int
    equations: int
    moving: bool
    parameters: ClassVar = ("forms", "shifts", "levels", "amplitudes", "inner", "outer")

    @property
    def n(self) -> int:
        return self.size

    @property
    def m(self) -> int:
        return self.equations

    def draw(self, rng, draws):
        n, m = self.n, self.m
        args = draw_drive(rng, draws, n)
        forms = rng.normal(size=(draws, m, n, n)) / np.sqrt(n)
        forms = (forms + np.swapaxes(forms, -1, -2)) / 2
        forms[:, 0] = 0.3 * forms[:, 0] + np.eye(n)
        args |= {
            "forms": forms,
            "shifts": 0.3 * rng.normal(size=(draws, m, n)),
            "amplitudes": 0.1 * self.moving * rng.uniform(0.5, 1.0, size=(draws, m)),
            "frequencies": rng.uniform(0.5, 3.0, size=(draws, m)),
        }
        y0 = np.empty((draws, n))
        rest = np.arange(draws)
        for _ in range(100):
            y0[rest] = rng.normal(size=(rest.size, n)) * rng.uniform(0.7, 1.3, (rest.size, 1))
            G = self.jacobian(np, y0, args)
            rest = np.flatnonzero(conditions(G) < REGULAR_START / m)
            if rest.size == 0:
                break
        return self._with_levels(args, y0), y0

    def _with_levels(self, args: Args, y0: np.ndarray) -> Args:
        return args | {"levels": self._value(np, y0, args)}

    def _value(self, xp: Any, y: Any, args: Args) -> Any:
        half = xp.einsum("...mij,...j->...mi", args["forms"], y) / 2 + args["shifts"]
        return xp.einsum("...mi,...i->...m", half, y)

    def jacobian(self, xp: Any, y: Any, args: Args) -> Any:
        return xp.einsum("...mij,...j->...mi", args["forms"], y) + args["shifts"]

    def raw(self, xp: Any, t: Any, y: Any, args: Args) -> Any:
        return modulation(xp, t, args) * drive(xp, t, y, args)

    def field(self, xp, t, y, args):
        angle = args["frequencies"] * since_start(xp, t, args)
        rate = -args["amplitudes"] * args["frequencies"] * xp.cos(angle)
        return tangent_part(xp, self.raw(xp, t, y, args), self.jacobian(xp, y, args), rate)

    def residual(self, xp, t, y, args):
        angle = args["frequencies"] * since_start(xp, t, args)
        return self._value(xp, y, args) - args["levels"] - args["amplitudes"] * xp.sin(angle)


@dataclasses.dataclass(frozen=True)
class Spheres(Family):
    """A product of `count` spheres in `R^dimension` with radii that change in time: many states,
    many equations, independent of each other."""

    count: int
    dimension: int
    parameters: ClassVar = ("radii", "pulses", "inner", "outer")

    @property
    def n(self) -> int:
        return self.count * self.dimension

    @property
    def m(self) -> int:
        return self.count

    def draw(self, rng, draws):
        args = draw_drive(rng, draws, self.n)
        args["radii"] = rng.uniform(0.5, 2.0, (draws, self.count))
        args["pulses"] = rng.uniform(0.05, 0.2, (draws, self.count))
        points = rng.normal(size=(draws, self.count, self.dimension))
        points *= (args["radii"] / np.linalg.norm(points, axis=-1))[..., None]
        return args, points.reshape(draws, self.n)

    def _points(self, y: Any) -> Any:
        return y.reshape(*y.shape[:-1], self.count, self.dimension)

    def field(self, xp, t, y, args):
        p = self._points(y)
        raw = self._points(modulation(xp, t, args) * drive(xp, t, y, args))
        growth = args["radii"] ** 2 * args["pulses"] * xp.cos(since_start(xp, t, args))
        normal = (xp.sum(p * raw, axis=-1) - growth) / xp.sum(p * p, axis=-1)
        return (raw - normal[..., None] * p).reshape(y.shape)

    def residual(self, xp, t, y, args):
        p = self._points(y)
        squares = args["radii"] ** 2 * (1 + 2 * args["pulses"] * xp.sin(since_start(xp, t, args)))
        return (xp.sum(p * p, axis=-1) - squares) / 2


@dataclasses.dataclass(frozen=True)
class Invariants(Family):
    """`y' = S grad H` with a constant skew matrix `S`: `H` is conserved, and with `casimir` a
    linear function, too."""

    size: int
    casimir: bool
    parameters: ClassVar = ("flow", "stiffness", "quartic", "normal")
    conserves: ClassVar = True

    @property
    def n(self) -> int:
        return self.size

    @property
    def m(self) -> int:
        return 1 + self.casimir

    def draw(self, rng, draws):
        n = self.n
        root = rng.normal(size=(draws, n, n)) / np.sqrt(n)
        args = {
            "flow": rng.normal(size=(draws, n, n)) / np.sqrt(n),
            "stiffness": root @ np.swapaxes(root, -1, -2) + 0.3 * np.eye(n),
            "quartic": rng.uniform(0.1, 0.5, (draws, n)),
            "normal": rng.normal(size=(draws, n)),
        }
        y0 = rng.normal(size=(draws, n))
        return self.settled(args, y0), y0

    def settled(self, args, y0):
        return args | {"values": self.invariants(np, y0, args)}

    def invariants(self, xp: Any, y: Any, args: Args) -> Any:
        quadratic = xp.sum(y * apply(xp, args["stiffness"], y), axis=-1) / 2
        energy = quadratic + xp.sum(args["quartic"] * y**4, axis=-1) / 4
        linear = xp.sum(args["normal"] * y, axis=-1)
        return xp.stack([energy, linear] if self.casimir else [energy], axis=-1)

    def residual(self, xp, t, y, args):
        return self.invariants(xp, y, args) - args["values"]

    def field(self, xp, t, y, args):
        stiffness = args["stiffness"] + xp.swapaxes(args["stiffness"], -1, -2)
        gradient = apply(xp, stiffness, y) / 2 + args["quartic"] * y**3
        skew = args["flow"] - xp.swapaxes(args["flow"], -1, -2)
        across = self._across(xp, gradient, args)
        return modulation(xp, t, args) * self._across(xp, apply(xp, skew, across), args)

    def _across(self, xp: Any, v: Any, args: Args) -> Any:
        """Without the part along the gradient of the linear invariant."""
        if not self.casimir:
            return v
        c = args["normal"]
        part = xp.sum(c * v, axis=-1) / xp.sum(c * c, axis=-1)
        return v - part[..., None] * c


@dataclasses.dataclass(frozen=True)
class Reactions(Family):
    """A stiff linear network of reactions: what there is in all is conserved."""

    size: int
    stiff: ClassVar = True
    parameters: ClassVar = ("rates",)

    @property
    def n(self) -> int:
        return self.size

    @property
    def m(self) -> int:
        return 1

    def draw(self, rng, draws):
        y0 = rng.uniform(0.1, 1.0, (draws, self.n))
        rates = 10 ** rng.uniform(-1.0, 4.0, (draws, self.n, self.n))
        return {"rates": rates, "total": y0.sum(axis=-1)}, y0

    def _matrix(self, xp: Any, args: Args) -> Any:
        rates = args["rates"] * (1 - np.eye(self.n))
        return rates - xp.sum(rates, axis=-2)[..., None, :] * np.eye(self.n)

    def field(self, xp, t, y, args):
        return modulation(xp, t, args) * apply(xp, self._matrix(xp, args), y)

    def residual(self, xp, t, y, args):
        return xp.sum(y, axis=-1, keepdims=True) - args["total"][..., None]

    def exact(self, t, y0, args):
        time = (t - args["start"])[:, None, None]
        return apply(np, scipy.linalg.expm(self._matrix(np, args) * time), y0)
