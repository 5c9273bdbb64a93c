"""Initial states of an assembly: completed from what is known of some bodies, and checked against the
joints. By NumPy if all numbers are known, otherwise (inside `jit`, `vmap` and derivatives) in the
traced program.

Source of the assembly analysis: Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems
(1989), ch. 4, here with steps of least norm, `x - J^+ phi(x)` in the coordinates that are free.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.dense import pseudo_invert
from .bodies import check_orientation, Pose
from .checks import check_shape, is_concrete, on_host, stack
from .rotations import quaternion_rate
from .system import ConstantAssembly, JointEquations


# Joints count as closed below this gap (m, or the sine of an angle), or this many units of rounding.
CLOSED, ROUNDING = 1e-6, 50
ITERATIONS = 50
# Singular values below this fraction of the largest belong to redundant equations; at least a hundred
# units of rounding.
DEPENDENT = 1e-9
# The same for eigenvalues of `J J^T`, in a traced program.
DEPENDENT_TRACED = 1e-12


def make_state(
    assembly: Any, given: tuple, assemble: bool, t: Array, args: Args
) -> tuple[Pose, Pose]:
    y, kept = _with_given(assembly, given)
    known = all(is_concrete(leaf) for leaf in jtu.tree_leaves((y, assembly, t, args)))
    if not known and not assemble:
        return y
    closure = LoopClosure(assembly, y, kept, t, args)
    if not known:
        return closure.assembled_when_run()
    if assemble:
        y = closure.assembled()
    closure.check(y)
    return y


def _with_given(
    assembly: Any, given: tuple
) -> tuple[tuple[Pose, Pose], tuple[np.ndarray, np.ndarray]]:
    """Return the state, and which of its coordinates and of their rates are given."""
    bodies = assembly.bodies
    q, planar = bodies.drawing, bodies.planar
    positions, orientations, velocities, spins = given
    d = 2 if planar else 3
    vector = lambda what, value: check_shape(what, value, (d,))
    turned = lambda what, value: check_orientation(what, value, planar)
    spin = (lambda what, value: check_shape(what, value, ())) if planar else vector
    x, has_x = _place(bodies, q.position, positions, "positions", vector)
    p, has_p = _place(bodies, q.orientation, orientations, "orientations", turned)
    still = np.zeros(q.coordinates.shape, q.coordinates.dtype)
    u, has_u = _place(bodies, still[:, :d], velocities, "velocities", vector)
    no_spin = still[:, 2] if planar else still[:, :3]
    w, has_w = _place(bodies, no_spin, spins, "angular_velocities", spin)
    rate = w if planar else quaternion_rate(p, w)
    widths = d, q.coordinates.shape[-1] - d
    kept = lambda *has: np.repeat(np.stack(has, axis=1), widths, axis=1)
    return (Pose(x, p), Pose(u, rate)), (kept(has_x, has_p), kept(has_u, has_w))


def _place(
    bodies: Any, rows: Any, by_name: Any, what: str, checked: Callable
) -> tuple[Array, np.ndarray]:
    """Return the rows, those that are given by name replaced, and which are given."""
    by_name = {} if by_name is None else by_name
    if not isinstance(by_name, dict):
        raise TypeError(f"`{what}` must be a dictionary of names of bodies, got {by_name!r}.")
    has = np.zeros(len(bodies.names), bool)
    rows = list(on_host(rows))
    for name, value in by_name.items():
        i = bodies.moving_index(name, f"`{what}`")
        rows[i], has[i] = checked(f"`{what}` of {name!r}", value), True
    return stack(rows), has


class LoopClosure:
    """Closes the loops of an assembly: its equations as functions of the vector `x` of all coordinates,
    and the state `x`, `w`, of which `free_x`, `free_w` may be moved."""

    def __init__(
        self, assembly: Any, y: tuple[Pose, Pose], kept: tuple[Any, Any], t: Array, args: Args
    ):
        self.assembly, self.at = assembly, (t, args)
        (self.x, self.unravel), (self.w, _) = map(jfu.ravel_pytree, y)
        self.free_x, self.free_w = (np.flatnonzero(~part) for part in kept)
        joints = JointEquations(ConstantAssembly(assembly))
        phi = lambda t, x: jfu.ravel_pytree(joints(t, self.unravel(x), args))[0]
        self.phi = lambda x: phi(t, x)
        self.jacobian = lambda x: jax.jacfwd(phi, 1)(t, x)
        # The rates of the equations at rest: those of drives.
        self.driven = lambda x: jax.jvp(lambda t: phi(t, x), (t,), (jnp.ones_like(t),))[1]
        compiled = jax.jit(lambda x: (self.phi(x), self.driven(x), self.jacobian(x)))
        self.known = lambda x: map(np.asarray, compiled(x))

    @functools.cached_property
    def named_rows(self) -> list[tuple[str, np.ndarray]]:
        """The rows of every joint among the equations."""
        (t, args), bodies = self.at, self.assembly.bodies
        of_joints = lambda: JointEquations(ConstantAssembly(self.assembly))(t, bodies.drawing, args)
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
        """Close the joints by Gauss-Newton steps of least norm in free coordinates; velocities by one."""
        x, w = self.closed(np.asarray(self.x)), np.array(self.w)
        advice = "Whatever the other bodies do, the joints cannot be closed: check lengths and points, or give less."
        self._check_positions(x, advice)
        _, driven, J = self.known(x)
        rate = driven + J @ w
        w[self.free_w] -= np.linalg.lstsq(J[:, self.free_w], rate, rcond=dependence_of(J.dtype))[0]
        return self.unravel(jnp.asarray(x)), self.unravel(jnp.asarray(w))

    def closed(self, x: np.ndarray) -> np.ndarray:
        """Return coordinates near `x` for which the joints are closed, if there are."""
        x = np.array(x)
        for _ in range(ITERATIONS):
            phi, _, J = self.known(x)
            if np.abs(phi).max(initial=0) < 10 * np.finfo(x.dtype).eps:
                break
            x[self.free_x] -= np.linalg.lstsq(J[:, self.free_x], phi, rcond=dependence_of(J.dtype))[
                0
            ]
        return x

    def check(self, y: tuple[Pose, Pose]) -> None:
        x, w = (np.array(jfu.ravel_pytree(part)[0]) for part in y)
        advice = "Give `assemble=True` to close them, or correct positions and orientations."
        self._check_positions(x, advice)
        _, driven, J = self.known(x)
        what = "The velocities do not agree with the joints"
        advice = "Give only those that are known, such that joints allow them, and `assemble=True`."
        most = _closed(x) * max(1, np.abs(w).max())
        self._refuse_gaps(np.abs(driven + J @ w), most, "in m/s or rad/s", what, advice, {})
        if not self.assembly.redundant:
            self._check_rank(J)

    def _check_positions(self, x: np.ndarray, advice: str) -> None:
        phi, _, _ = self.known(x)
        what = "The state does not satisfy the joints"
        groups = [group for group in self.assembly.joints if group.unit]
        units = {name: f" {group.unit}" for group in groups for name in group.attachment.names}
        gaps, unit = np.abs(phi), "in m or the sine of an angle"
        self._refuse_gaps(gaps, _closed(x), unit, what, advice, units)

    def _refuse_gaps(
        self, gaps: np.ndarray, most: float, unit: str, what: str, advice: str, units: dict
    ) -> None:
        """Raise with the joints of the largest gaps, if any is too large; some have `units` of their own."""
        if gaps.max(initial=0) <= most:
            return
        sizes = [(name, gaps[rows].max()) for name, rows in self.named_rows]
        order = np.argsort([size for _, size in sizes])[::-1][:5]
        largest = [sizes[i] for i in order if not sizes[i][1] <= most]
        worst = ", ".join(f"{name} (gap {x:.3g}{units.get(name, '')})" for name, x in largest)
        others = "" if all(name in units for name, _ in largest) else f", {unit}"
        raise ValueError(f"{what}: {worst}{others}. {advice}")

    def _check_rank(self, J: np.ndarray) -> None:
        solved = self.assembly.independent
        rows = np.arange(J.shape[0]) if solved is None else np.array(solved.rows)
        refuse_dependent(J, rows, self.named_rows)

    def assembled_when_run(self) -> tuple[Pose, Pose]:
        """Take the same steps in a traced program, with derivatives through all of them. At run time an
        error says which joint could not be closed."""

        def corrected(x: Float[Array, " n"]) -> Float[Array, " n"]:
            J = self.jacobian(x)[:, self.free_x]
            return x.at[self.free_x].add(-_least_norm(J, self.phi(x)))

        def iterate(x: Float[Array, " n"], _: Any) -> tuple[Float[Array, " n"], None]:
            unfinished = jnp.max(jnp.abs(self.phi(x)), initial=0) >= 10 * jnp.finfo(x.dtype).eps
            return jax.lax.cond(unfinished, corrected, lambda x: x, x), None

        x, _ = jax.lax.scan(iterate, self.x, None, length=ITERATIONS)
        x = corrected(x)  # its derivative is that of the root
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


def dependent_equations(J: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how many of the rows depend on others, and which rows take part."""
    J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), np.finfo(J.dtype).tiny)
    left, sizes, _ = np.linalg.svd(J, full_matrices=True)
    rank = int(np.sum(sizes > dependence_of(J.dtype) * sizes.max(initial=1)))
    return J.shape[0] - rank, np.abs(left[:, rank:]).max(axis=1, initial=0) > 1e-6


def refuse_dependent(
    J: np.ndarray, solved: np.ndarray, named_rows: list[tuple[str, np.ndarray]]
) -> None:
    """Raise if some of the rows that are `solved` depend on others, with the names of joints that take part."""
    number, dependent = dependent_equations(J[solved])
    if number == 0:
        return
    among = np.zeros(J.shape[0], bool)
    among[solved[dependent]] = True
    names = [name for name, rows in named_rows if among[rows].any()]
    raise ValueError(
        f"{number} of the {J.shape[0]} equations of the joints depend on others in this pose, among those of "
        f"{', '.join(names[:10])}{', ...' if len(names) > 10 else ''}. If they do so in every pose (closed loops), "
        "write `Assembly(..., redundant=True)`, or take `assembly.without_dependent_equations()`; if in this one alone, "
        "start beside it."
    )


def _least_norm(J: Float[Array, "m n"], b: Float[Array, " m"]) -> Float[Array, " n"]:
    return J.T @ pseudo_invert(J @ J.T, DEPENDENT_TRACED).solve(b)


def _closed(x: np.ndarray) -> float:
    largest = float(np.abs(x).max(initial=1))
    return max(CLOSED, ROUNDING * float(np.finfo(x.dtype).eps) * largest)


def dependence_of(dtype: Any) -> float:
    """Return the fraction of the largest singular value below which others belong to dependent equations."""
    return max(DEPENDENT, 100 * float(jnp.finfo(dtype).eps))
