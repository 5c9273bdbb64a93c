"""Whether a state satisfies the joints of an assembly, and how it comes to: by NumPy where all numbers are
known, otherwise (inside of `jit`, `vmap` and derivatives) in the program that is traced.

Source of the assembly analysis: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems
(1989), ch. 4, here with steps of least norm, `x - J^+ phi(x)` in what is free.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.dense import pseudo_invert
from .bodies import Pose


# Joints count as closed below this gap (m, or the cosine of an angle), or this many units of rounding.
CLOSED, ROUNDING = 1e-6, 50
ITERATIONS = 50
# Singular values below this fraction of the largest belong to equations that depend on others; at
# least a hundred units of rounding.
DEPENDENT = 1e-9
# Likewise eigenvalues of `J J^T`, in a program that is traced.
DEPENDENT_TRACED = 1e-12


class Closing:
    """The equations of an assembly as functions of the vector `x` of its coordinates, from the state
    `x`, `w` whose `free_x`, `free_w` may be moved."""

    def __init__(
        self, assembly: Any, y: tuple[Pose, Pose], kept: tuple[Any, Any], t: Array, args: Args
    ):
        self.assembly, self.at = assembly, (t, args)
        (self.x, self.unravel), (self.w, _) = map(jfu.ravel_pytree, y)
        self.free_x, self.free_w = (np.flatnonzero(~part) for part in kept)
        joints = assembly.system.holonomic
        phi = lambda t, x: jfu.ravel_pytree(joints(t, self.unravel(x), args))[0]
        self.phi = lambda x: phi(t, x)
        self.jacobian = lambda x: jax.jacfwd(phi, 1)(t, x)
        # The rates of the equations while nothing moves: those of drives.
        self.driven = lambda x: jax.jvp(lambda t: phi(t, x), (t,), (jnp.ones_like(t),))[1]
        self.compiled = jax.jit(lambda x: (self.phi(x), self.driven(x), self.jacobian(x)))

    def known(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals, their rates while nothing moves, and their Jacobian, as NumPy arrays."""
        phi, driven, J = map(np.asarray, self.compiled(x))
        return phi, driven, J

    @functools.cached_property
    def named_rows(self) -> list[tuple[str, np.ndarray]]:
        """The rows of every joint among the equations."""
        (t, args), bodies = self.at, self.assembly.bodies
        of_joints = lambda: self.assembly.system.holonomic(t, bodies.drawing, args)
        named, start = [], 0
        for group, part in zip(self.assembly.joints, jax.eval_shape(of_joints), strict=False):
            rows = start + np.arange(part.size).reshape(part.shape)
            named += list(zip(group.attachment.names, rows, strict=True))
            start += part.size
        norms = () if bodies.planar else bodies.names
        return named + [
            (f"norm of {name!r}", np.array([start + i])) for i, name in enumerate(norms)
        ]

    def assembled(self) -> tuple[Pose, Pose]:
        """Gauss-Newton steps of least norm in what is free; velocities by one."""
        x, w = np.array(self.x), np.array(self.w)
        for _ in range(ITERATIONS):
            phi, _, J = self.known(x)
            if np.abs(phi).max(initial=0) < 10 * np.finfo(x.dtype).eps:
                break
            x[self.free_x] -= np.linalg.lstsq(J[:, self.free_x], phi, rcond=_dependent(J))[0]
        reason = " Whatever the other bodies do, the joints cannot be closed: check lengths and points, or give less."
        self._check_positions(x, reason)
        _, driven, J = self.known(x)
        rate = driven + J @ w
        w[self.free_w] -= np.linalg.lstsq(J[:, self.free_w], rate, rcond=_dependent(J))[0]
        return self.unravel(jnp.asarray(x)), self.unravel(jnp.asarray(w))

    def check(self, y: tuple[Pose, Pose]) -> None:
        x, w = (np.array(jfu.ravel_pytree(part)[0]) for part in y)
        self._check_positions(
            x, " Give `assemble=True` to close them, or correct positions and orientations."
        )
        _, driven, J = self.known(x)
        rate = np.abs(driven + J @ w)
        most = _closed(x) * max(1, np.abs(w).max())
        if not rate.max(initial=0) <= most:
            worst = self._worst(rate, most, "m/s")
            raise ValueError(
                f"The velocities do not agree with the joints: {worst}. Give only those that are known, "
                "such that joints allow them, and `assemble=True`."
            )
        if not self.assembly.redundant:
            self._check_rank(J)

    def _check_positions(self, x: np.ndarray, advice: str) -> None:
        gap, most = np.abs(self.known(x)[0]), _closed(x)
        if not gap.max(initial=0) <= most:
            worst = self._worst(gap, most, "m")
            raise ValueError(f"The state does not satisfy the joints: {worst}.{advice}")

    def _worst(self, size: np.ndarray, most: float, unit: str) -> str:
        named = self.named_rows
        largest = [size[rows].max() for _, rows in named]
        order = np.argsort(largest)[::-1][:5]
        worst = [(named[i][0], largest[i]) for i in order if not largest[i] <= most]
        return ", ".join(f"{name} (gap {gap:.3g} {unit})" for name, gap in worst)

    def _check_rank(self, J: np.ndarray) -> None:
        J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), np.finfo(J.dtype).tiny)
        left, sizes, _ = np.linalg.svd(J, full_matrices=True)
        rank = int(np.sum(sizes > _dependent(J) * sizes.max(initial=1)))
        if rank == J.shape[0]:
            return
        among = np.abs(left[:, rank:]).max(axis=1)
        names = [name for name, rows in self.named_rows if among[rows].max() > 1e-6]
        raise ValueError(
            f"{J.shape[0] - rank} of the {J.shape[0]} equations of the joints depend on others in this pose, among those of "
            f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}. If they do so in every pose (closed loops), "
            "write `Assembly(..., redundant=True)`; if in this one alone, start beside it."
        )

    def assembled_when_run(self) -> tuple[Pose, Pose]:
        """The same steps in a traced program, with derivatives through all of them. While it runs an
        error says which joint could not be closed."""

        def corrected(x: Float[Array, " n"]) -> Float[Array, " n"]:
            J = self.jacobian(x)[:, self.free_x]
            return x.at[self.free_x].add(-_least_norm(J, self.phi(x)))

        def iterate(x: Float[Array, " n"], _: Any) -> tuple[Float[Array, " n"], None]:
            unfinished = jnp.max(jnp.abs(self.phi(x)), initial=0) >= 10 * jnp.finfo(x.dtype).eps
            return jax.lax.cond(unfinished, corrected, lambda x: x, x), None

        x, _ = jax.lax.scan(iterate, self.x, None, length=ITERATIONS)
        x = corrected(x)  # of which the derivative is that of a root
        J, driven = self.jacobian(x), self.driven(x)
        rate = lambda w: driven + J @ w
        w = self.w.at[self.free_w].add(-_least_norm(J[:, self.free_w], rate(self.w)))
        largest = jnp.maximum(1, jnp.max(jnp.abs(jax.lax.stop_gradient(w)), initial=0))
        x = self._raise_unless_closed(x, self.phi(x), "the joints cannot be closed")
        fault = "the velocities given disagree with the joints"
        w = self._raise_unless_closed(w, rate(w) / largest, fault)
        return self.unravel(x), self.unravel(w)

    def _raise_unless_closed(
        self, x: Float[Array, " n"], gap: Float[Array, " m"], fault: str
    ) -> Float[Array, " n"]:
        gaps = jnp.stack([jnp.max(jnp.abs(gap[rows])) for _, rows in self.named_rows])
        messages = [
            f"`assemble=True`: whatever the other bodies do, {fault}, {name} least of all. Check lengths and points, or "
            "give less."
            for name, _ in self.named_rows
        ]
        failed = ~(jnp.max(gaps) <= _closed(np.zeros(1, x.dtype)))
        worst = jnp.argmax(jnp.where(jnp.isnan(gaps), jnp.inf, gaps))
        return eqx.branched_error_if(x, failed, worst, messages)


def _least_norm(J: Float[Array, "m n"], b: Float[Array, " m"]) -> Float[Array, " n"]:
    return J.T @ pseudo_invert(J @ J.T, equilibrated=True, dependent=DEPENDENT_TRACED).solve(b)


def _closed(x: np.ndarray) -> float:
    largest = float(np.abs(x).max(initial=1))
    return max(CLOSED, ROUNDING * float(np.finfo(x.dtype).eps) * largest)


def _dependent(J: np.ndarray) -> float:
    return max(DEPENDENT, 100 * float(np.finfo(J.dtype).eps))
