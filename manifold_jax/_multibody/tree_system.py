"""The mechanical system of an assembly in the coordinates of a spanning tree."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._linalg.dense import gram
from .._mechanics import AbstractPositionsWithBias
from .attachment import Attachment
from .frames import Frames, Placed
from .joint_groups import bodies_of, JointGroup, residuals_of
from .loads import add
from .rotations import turn
from .spanning_tree import SpanningTree
from .start import dependence_of
from .tree_motion import TreeMotion, TreePlacement
from .tree_readings import poses_of


class TreeMass(eqx.Module):
    """`M = sum_i m_i V_i^T V_i + W_i^T I_i W_i` with the derivatives `V_i` of the velocities of the bodies by
    those of `q`, and `W_i` of the angular velocities; on the diagonal also the inertias of rotors. Singular along
    quaternions, whose norms are constraints."""

    source: Callable
    tree: SpanningTree = eqx.field(static=True)

    def __call__(self, q: Float[Array, " n"], args: Args) -> Float[Array, "n n"]:
        assembly = self.source(args)
        motion = motion_of(assembly, self.tree)
        at = motion.place(q)
        along, about = motion.jacobians(at)
        rows = lambda J: jnp.moveaxis(J, 1, 0).reshape(J.shape[1], -1)
        momentum = motion.bodies.mass[:, None, None] * along
        turning = jnp.sum(motion.inertia(at)[:, None] * about[:, :, None, :], axis=3)
        half = gram(
            rows(jnp.concatenate([along, about])), rows(jnp.concatenate([momentum, turning]))
        )
        mass = (half + half.T) / 2
        for rotors in assembly.rotors:
            own = motion.coordinates.numbers_of(rotors.joints)
            mass = mass.at[own, own].add(rotors.inertia.astype(mass.dtype))
        return mass


class TreeForces(eqx.Module):
    """Weight and loads, and the inertial forces of the bodies where the accelerations of `q` are zero."""

    source: Callable
    tree: SpanningTree = eqx.field(static=True)

    def __call__(
        self, t: RealScalarLike, q: Float[Array, " n"], v: Float[Array, " n"], args: Args
    ) -> Float[Array, " n"]:
        assembly = self.source(args)
        motion = motion_of(assembly, self.tree)
        at = motion.place(q)
        frames = motion.frames(at, v)
        mass, spin = motion.bodies.mass[:, None], frames.spin[:-1]
        total = (
            jnp.pad(mass * assembly.gravity[None], ((0, 1), (0, 0))),
            jnp.zeros_like(frames.origin),
        )
        poses, known = poses_of(motion, q, v), motion.coordinates.known(q)
        for loads in assembly.loads:
            total = add(total, loads.wrench(t, poses, frames, known, args))
        inertia, (acceleration, turning) = motion.inertia(at), motion.bias(at, frames, v)
        force = total[0][:-1] - mass * acceleration
        torque = total[1][:-1] - turn(inertia, turning) - jnp.cross(spin, turn(inertia, spin))
        along, about = motion.jacobians(at)
        return jnp.sum(along * force[:, None] + about * torque[:, None], axis=(0, 2))


class LoopEquations(AbstractPositionsWithBias):
    """The equations of the joints that close loops, of drives, of couplings, and the norms of quaternions: all, or
    those of the given numbers."""

    source: Callable
    tree: SpanningTree = eqx.field(static=True)
    rows: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def __call__(self, t: RealScalarLike, q: Float[Array, " n"], args: Args) -> Float[Array, " m"]:
        assembly = self.source(args)
        motion = motion_of(assembly, self.tree)
        loops = Loops.of(assembly.joints_at(t, args), self.tree)
        parts = [part.reshape(-1) for part in loops.residuals(motion.place(q))]
        parts.append(assembly.couplings.residual(motion.coordinates, q))
        p = q[motion.coordinates.quaternions()]
        parts.append((jnp.sum(p * p, axis=1) - 1) / 2)
        found = jnp.concatenate(parts)
        return found if self.rows is None else found[np.array(self.rows, int)]

    def jacobian(self, t: RealScalarLike, q: Float[Array, " n"], args: Args) -> Float[Array, "m n"]:
        assembly = self.source(args)
        motion = motion_of(assembly, self.tree)
        at, numbers = motion.place(q), motion.coordinates.quaternions()
        loops = Loops.of(assembly.joints_at(t, args), self.tree)
        J = jnp.concatenate(motion.jacobians(at), axis=2)
        norms = jnp.zeros((numbers.shape[0], q.size), q.dtype)
        norms = norms.at[np.arange(numbers.shape[0])[:, None], numbers].set(q[numbers])
        coupled = assembly.couplings.jacobian(motion.coordinates, q)
        # Those that hold identically were found before if the others are numbered.
        closed = loops.jacobian(at, J, some_hold=assembly.redundant)
        rows = jnp.concatenate([*closed, coupled, norms])
        return rows if self.rows is None else rows[np.array(self.rows, int)]

    def bias(
        self, t: RealScalarLike, q: Float[Array, " n"], v: Float[Array, " n"], args: Args
    ) -> Float[Array, " m"]:
        assembly = self.source(args)
        motion = motion_of(assembly, self.tree)
        numbers = motion.coordinates.quaternions()
        at = motion.place(q)
        frames = motion.frames(at, v)
        accelerations = motion.bias(at, frames, v)

        def rate(t: Any, since: Any) -> tuple[Float[Array, "_ _"], ...]:
            """Return the time derivatives of the residuals at `t`, when bodies moved since."""
            path = lambda t, since: Loops.of(assembly.joints_at(t, args), self.tree).along(
                frames, accelerations, since
            )
            return jax.jvp(path, (t, since), (jnp.ones_like(t), jnp.ones_like(since)))[1]

        t, now = jnp.asarray(t, q.dtype), jnp.zeros((), q.dtype)
        _, found = jax.jvp(rate, (t, now), (jnp.ones_like(t), jnp.ones_like(now)))
        norms = jnp.sum(v[numbers] ** 2, axis=1)
        coupled = assembly.couplings.bias(motion.coordinates, q, v)
        rows = jnp.concatenate([*(part.reshape(-1) for part in found), coupled, norms])
        return rows if self.rows is None else rows[np.array(self.rows, int)]


class Loops(NamedTuple):
    """The joints that are no part of the tree, and drives."""

    groups: tuple[JointGroup, ...]

    @staticmethod
    def of(groups: tuple[JointGroup, ...], tree: SpanningTree) -> "Loops":
        pairs = zip(groups, tree.loops, strict=True)
        return Loops(tuple(_part(group, np.array(own)) for group, own in pairs if own))

    def residuals(self, at: TreePlacement) -> tuple[Float[Array, "_ _"], ...]:
        return residuals_of(self.groups, self._placed(at))

    def _placed(self, at: TreePlacement) -> Placed:
        index = bodies_of(self.groups)
        return Placed(*(part[index] for part in at.placed))

    def along(
        self, frames: Frames, accelerations: tuple[Array, Array], since: Float[Array, ""]
    ) -> tuple[Float[Array, "_ _"], ...]:
        """Return the residuals of bodies that move with these velocities and accelerations, to second order."""
        index = bodies_of(self.groups)
        acceleration, turning = (jnp.pad(part, ((0, 1), (0, 0)))[index] for part in accelerations)
        origin, R, velocity, spin = (part[index] for part in frames)
        turned = lambda w, R: jnp.cross(w[..., None], R, axis=-2)
        rate = turned(spin, R)
        bend = turned(turning, R) + turned(spin, rate)
        half = since * since / 2
        origin = origin + since * velocity + half * acceleration
        return residuals_of(self.groups, Placed(origin, R + since * rate + half * bend))

    def jacobian(
        self, at: TreePlacement, J: Float[Array, "b n 6"], *, some_hold: bool
    ) -> tuple[Float[Array, "_ n"], ...]:
        """Return the derivatives by `q`: those by motions of the two bodies of each joint, times the
        derivatives `J` of these. If joints of the tree may satisfy some equations by themselves, such as those
        across the plane of a linkage, zero for these, not rounding."""
        if not self.groups:
            return ()
        placed, index = self._placed(at), bodies_of(self.groups)

        def moved(motion: Float[Array, "2 k 6"]) -> tuple[Float[Array, "_ _"], ...]:
            """Shift and turn the bodies, to first order."""
            shift, angle = motion[..., :3], motion[..., 3:]
            turned = placed.rotation + jnp.cross(angle[..., None], placed.rotation, axis=-2)
            return residuals_of(self.groups, Placed(placed.origin + shift, turned))

        still = jnp.zeros((*index.shape, 6), J.dtype)
        along = lambda seed: jax.jvp(
            moved, (still,), (jnp.broadcast_to(seed[:, None, :], still.shape),)
        )[1]
        slopes = jax.vmap(along)(jnp.eye(12, dtype=J.dtype).reshape(12, 2, 6))
        motions = jnp.pad(J, ((0, 1), (0, 0), (0, 0)))[index]  # (2, K, n, 6)
        motions = jnp.moveaxis(motions, 3, 1).reshape(12, *motions.shape[1:3])
        sizes = self._sizes(at, motions) if some_hold else None
        found, start = [], 0
        for slope in slopes:
            part = slice(start, start := start + slope.shape[1])
            rows = jnp.sum(slope[:, :, :, None] * motions[:, part, None, :], axis=0)
            if sizes is not None:
                terms = jnp.sum(jnp.abs(slope) * sizes[:, part, None], axis=0)
                holds = jnp.max(jnp.abs(rows), axis=2) <= dependence_of(rows.dtype) * terms
                rows = jnp.where(holds[:, :, None], 0, rows)
            found.append(rows.reshape(-1, rows.shape[2]))
        return tuple(found)

    def _sizes(self, at: TreePlacement, motions: Float[Array, "12 k n"]) -> Float[Array, "12 k"]:
        """Return how large the terms are that add up to motions of the bodies of each joint: a point on the axis of a
        hinge is moved by rounding, of what a point as far away beside it is moved."""
        largest = jnp.max(jnp.abs(motions), axis=2).reshape(2, 2, 3, -1)
        linear, angular = (jnp.max(part, axis=1) for part in jnp.moveaxis(largest, 1, 0))
        points = jnp.concatenate([at.origin[:-1], at.point])
        points_in_bodies = jnp.concatenate([g.attachment.points for g in self.groups], axis=1)
        reach = jnp.max(jnp.ptp(points, axis=0)) + jnp.max(jnp.abs(points_in_bodies), axis=2)
        both = jnp.stack([linear + reach * angular, angular], axis=1)
        return jnp.repeat(both.reshape(4, -1), 3, axis=0)


def _part(group: JointGroup, own: np.ndarray) -> JointGroup:
    """Return some of the joints of a group."""
    attachment = group.attachment
    if len(own) == len(attachment.names):
        return group
    names = tuple(attachment.names[i] for i in own)
    first, second = (tuple(side[i] for i in own) for side in attachment.bodies)
    part = Attachment(names, (first, second), attachment.points[:, own], attachment.axes[:, own])
    return dataclasses.replace(group, attachment=part, length=group.length[own])


def motion_of(assembly: Any, tree: SpanningTree) -> TreeMotion:
    return TreeMotion(assembly.bodies, assembly.joints, tree)
