"""Random mechanical systems; see `_fuzz_families`. States are `(q, v)` one after the other.

What the library derives from `phi` is written out here: Jacobian, velocities, accelerations.
"""

import abc
import dataclasses
from typing import Any, ClassVar

import numpy as np

from .families import apply, Args, Family, modulation, since_start


MASSES = ("scalar", "diagonal", "matrix", "lagrangian")


@dataclasses.dataclass(frozen=True)
class Mechanics(Family):
    """`M a + C^T lambda = Q`, `C v = b(t)`, the first rows of `C` derivatives of `phi(t, q) = 0`.

    `mass` is one of `MASSES`. Springs, damping and gravity; `modulation` multiplies all of them.
    """

    mass: str
    span: ClassVar = 1.5
    parameters: ClassVar = ("masses", "stiffness", "damping", "gravity")
    mechanical: ClassVar = True
    rolls: ClassVar[bool] = False  # whether there are constraints on velocities alone

    @property
    @abc.abstractmethod
    def coordinates(self) -> int: ...

    @property
    def n(self) -> int:
        return 2 * self.coordinates

    @abc.abstractmethod
    def draw_geometry(self, rng: np.random.Generator, draws: int) -> tuple[Args, np.ndarray]:
        """Parameters of the constraints, and positions that satisfy them."""

    def position(self, xp: Any, t: Any, q: Any, args: Args) -> Any | None:
        """`phi`."""
        return None

    def rolling(self, xp: Any, t: Any, q: Any, v: Any, args: Args) -> Any:
        """`A v - b`, constraints that are not derivatives of positions."""
        raise NotImplementedError

    @abc.abstractmethod
    def rows(self, t: Any, q: Any, args: Args) -> np.ndarray:
        """`C`."""

    @abc.abstractmethod
    def bias(self, t: Any, q: Any, v: Any, args: Args) -> tuple[np.ndarray, np.ndarray]:
        """`C v - b` at `v = 0`, and its rate of change at constant `v`."""

    def draw(self, rng, draws):
        k = self.coordinates
        args, q = self.draw_geometry(rng, draws)
        root = rng.normal(size=(draws, k, k)) / np.sqrt(k)
        args |= {
            "masses": {
                "scalar": rng.uniform(0.5, 2.0, draws),
                "diagonal": rng.uniform(0.5, 2.0, (draws, k)),
            }.get(self.mass, root @ np.swapaxes(root, -1, -2) + np.eye(k)),
            "stiffness": rng.uniform(0.5, 2.0, (draws, k)),
            "anchor": q + 0.3 * rng.normal(size=(draws, k)),
            "damping": rng.uniform(0.0, 0.5, (draws, k)),
            "gravity": rng.normal(size=(draws, k)),
        }
        v = 0.5 * rng.normal(size=(draws, k))
        start = np.zeros(draws)
        C = self.rows(start, q, args | {"start": start})
        drift, _ = self.bias(start, q, v, args | {"start": start})
        gap = apply(np, C, v) + drift
        v = v - np.einsum("...mi,...m->...i", C, np.linalg.solve(_gram(C), gap[..., None])[..., 0])
        return args, np.concatenate([q, v], axis=-1)

    def force(self, xp: Any, t: Any, q: Any, v: Any, args: Args) -> Any:
        pull = args["gravity"] - args["stiffness"] * (q - args["anchor"]) - args["damping"] * v
        return modulation(xp, t, args) * pull

    def potential(self, xp: Any, t: Any, q: Any, args: Args) -> Any:
        """Of gravity and springs; `friction` is the rest of `force`."""
        energy = args["stiffness"] * (q - args["anchor"]) ** 2 / 2 - args["gravity"] * q
        return xp.sum(modulation(xp, t, args) * energy, axis=-1)

    def friction(self, xp: Any, t: Any, v: Any, args: Args) -> Any:
        return -modulation(xp, t, args) * args["damping"] * v

    def mass_matrix(self, args: Args) -> np.ndarray:
        masses = args["masses"]
        if self.mass == "scalar":
            return masses[..., None, None] * np.eye(self.coordinates)
        return masses[..., None] * np.eye(self.coordinates) if self.mass == "diagonal" else masses

    def field(self, xp, t, y, args):
        q, v = np.split(y, 2, axis=-1)
        M, C = self.mass_matrix(args), self.rows(t, q, args)
        _, rate = self.bias(t, q, v, args)
        across = np.linalg.solve(M, np.swapaxes(C, -1, -2))
        free = np.linalg.solve(M, self.force(np, t, q, v, args)[..., None])[..., 0]
        gap = apply(np, C, free) + rate
        a = free - apply(np, across, np.linalg.solve(C @ across, gap[..., None])[..., 0])
        return np.concatenate([v, a], axis=-1)

    def residual(self, xp, t, y, args):
        q, v = np.split(y, 2, axis=-1)
        position = self.position(np, t, q, args)
        velocity = apply(np, self.rows(t, q, args), v) + self.bias(t, q, v, args)[0]
        return velocity if position is None else np.concatenate([position, velocity], axis=-1)


def _gram(C: np.ndarray) -> np.ndarray:
    return C @ np.swapaxes(C, -1, -2)


@dataclasses.dataclass(frozen=True)
class Linkage(Mechanics):
    """Points in the plane or in space, each at a fixed distance from its `parents` entry (an
    earlier point, or -1 for a pivot, which swings if `moving`). With `redundant` the first
    distance is given to the library twice."""

    dimension: int
    parents: tuple[int, ...]
    moving: bool
    redundant: bool

    @property
    def coordinates(self) -> int:
        return self.dimension * len(self.parents)

    @property
    def m(self) -> int:
        return 2 * len(self.parents)

    def draw_geometry(self, rng, draws):
        d = self.dimension
        links = rng.normal(size=(draws, len(self.parents), d))
        links *= rng.uniform(0.5, 1.5, (draws, len(self.parents), 1)) / np.linalg.norm(
            links, axis=-1, keepdims=True
        )
        points = np.zeros((draws, len(self.parents), d))
        for i, parent in enumerate(self.parents):
            points[:, i] = links[:, i] + (points[:, parent] if parent >= 0 else 0)
        args = {
            "squares": np.sum(links**2, axis=-1),
            "swing": 0.2 * self.moving * rng.normal(size=(draws, d)),
            "swing_frequency": rng.uniform(0.5, 3.0, draws),
        }
        return args, points.reshape(draws, -1)

    def _pivot(self, xp: Any, t: Any, args: Args, derivative: int) -> Any:
        """The pivot swings around the origin; its `derivative`-th derivative in time."""
        w = args["swing_frequency"][..., None]
        wave = (xp.sin, xp.cos, lambda a: -xp.sin(a))[derivative]
        return args["swing"] * w**derivative * wave(w * since_start(xp, t, args))

    def _links(self, xp: Any, x: Any, pivot: Any) -> Any:
        """From its parent to each point: of positions, velocities or accelerations."""
        points = x.reshape(*x.shape[:-1], len(self.parents), self.dimension)
        origin = [pivot if i < 0 else points[..., i, :] for i in self.parents]
        return points - xp.stack(origin, axis=-2)

    def position(self, xp, t, q, args):
        links = self._links(xp, q, self._pivot(xp, t, args, 0))
        return (xp.sum(links**2, axis=-1) - args["squares"]) / 2

    def rows(self, t, q, args):
        links = self._links(np, q, self._pivot(np, t, args, 0))
        count = len(self.parents)
        C = np.zeros((*q.shape[:-1], count, count, self.dimension))
        for i, parent in enumerate(self.parents):
            C[..., i, i, :] += links[..., i, :]
            if parent >= 0:
                C[..., i, parent, :] -= links[..., i, :]
        return C.reshape(*q.shape[:-1], count, q.shape[-1])

    def bias(self, t, q, v, args):
        pivots = [self._pivot(np, t, args, k) for k in range(3)]
        still = np.zeros_like(v)
        links, rates = self._links(np, q, pivots[0]), self._links(np, v, pivots[1])
        drift = np.sum(links * self._links(np, still, pivots[1]), axis=-1)
        acceleration = np.sum(links * self._links(np, still, pivots[2]), axis=-1)
        return drift, np.sum(rates**2, axis=-1) + acceleration


@dataclasses.dataclass(frozen=True)
class Rolling(Mechanics):
    """`(a + sin(W q)) . v = b sin(w t)`, a constraint on velocities that cannot be integrated;
    on a sphere with `sphere`."""

    size: int
    sphere: bool
    rolls: ClassVar = True

    @property
    def coordinates(self) -> int:
        return self.size

    @property
    def m(self) -> int:
        return 1 + 2 * self.sphere

    def draw_geometry(self, rng, draws):
        k = self.size
        args = {
            "fixed": np.eye(k)[0] + 0.3 * rng.normal(size=(draws, k)),
            "turning": 0.5 * rng.normal(size=(draws, k, k)) / np.sqrt(k),
            "speed": 0.3 * rng.normal(size=draws),
            "speed_frequency": rng.uniform(0.5, 3.0, draws),
        }
        q = rng.normal(size=(draws, k))
        q[:, 0] *= 0.3  # away from where both rows are parallel
        return args | {"square": np.sum(q**2, axis=-1)}, q

    def _direction(self, xp: Any, q: Any, args: Args) -> Any:
        return args["fixed"] + xp.sin(apply(xp, args["turning"], q))

    def position(self, xp, t, q, args):
        if not self.sphere:
            return None
        return (xp.sum(q**2, axis=-1) - args["square"])[..., None] / 2

    def rolling(self, xp, t, q, v, args):
        speed = args["speed"][..., None] * xp.sin(
            args["speed_frequency"][..., None] * since_start(xp, t, args)
        )
        return xp.sum(self._direction(xp, q, args) * v, axis=-1)[..., None] - speed

    def rows(self, t, q, args):
        rows = [self._direction(np, q, args)]
        return np.stack([q, *rows] if self.sphere else rows, axis=-2)

    def bias(self, t, q, v, args):
        w = args["speed_frequency"]
        angle = w * (t - args["start"])
        turning = np.cos(apply(np, args["turning"], q)) * apply(np, args["turning"], v)
        drift = [-args["speed"] * np.sin(angle)]
        rate = [np.sum(turning * v, axis=-1) - args["speed"] * w * np.cos(angle)]
        if self.sphere:
            drift, rate = [np.zeros_like(drift[0]), *drift], [np.sum(v**2, axis=-1), *rate]
        return np.stack(drift, axis=-1), np.stack(rate, axis=-1)
