"""Loads of tendons through several joints, all together."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import Args, FloatScalar, RealScalarLike
from . import forces, joints
from .attachment import Attachment
from .checks import as_pair, check_shape, is_concrete, on_host, stack
from .frames import Frames
from .joint_groups import attachment_of, find_joint, JointGroup
from .known_coordinates import HALF_TURN, KnownCoordinates
from .loads import AbstractLoads, apply_in_joints, SpringLaws, State, Wrench


class TendonLoads(AbstractLoads):
    """The loads of `m` tendons through `k` joints in all, each with its tendon and its coefficient. `lower` and
    `upper` are limits of the forces of those tendons that are `limited`."""

    hinges: tuple[bool, ...] = eqx.field(static=True)
    tendons: tuple[int, ...] = eqx.field(static=True)
    limited: tuple[bool, ...] = eqx.field(static=True)
    attachment: Attachment
    coefficients: Float[Array, " k"]
    laws: SpringLaws
    lower: Float[Array, " m"]
    upper: Float[Array, " m"]

    def wrench(
        self, t: RealScalarLike, y: State, frames: Frames, known: KnownCoordinates, args: Args
    ) -> Wrench:
        sides = self.attachment.sides(frames)
        turning, sliding = (self.attachment.rates(frames, sides, hinge) for hinge in (True, False))
        rate = self._sums(jnp.where(np.array(self.hinges), turning, sliding))
        pull = -self.laws.force(self._lengths(frames, known), rate, t, args)
        bounded = jnp.clip(pull, self.lower, self.upper)
        pull = jnp.where(np.array(self.limited), bounded, pull)
        values = self.coefficients * pull[np.array(self.tendons)]
        return apply_in_joints(frames, self.attachment, self.hinges, values)

    def potential(self, frames: Frames, known: KnownCoordinates) -> FloatScalar:
        stretch = jnp.where(
            np.array(self.limited), 0, self._lengths(frames, known) - self.laws.rest
        )
        return jnp.sum(self.laws.stiffness * stretch**2) / 2

    @property
    def joints_with_whole_turns(self) -> tuple[str, ...]:
        """The hinges of servo motors, which are tendons of one hinge, that turn to beyond half a turn."""
        numbers = self.laws.stiffness, self.laws.rest, self.coefficients
        if not all(map(is_concrete, numbers)):
            return ()
        (stiffness, rest, radii), tendons = map(np.asarray, numbers), np.array(self.tendons)
        values = np.zeros((2, 1)) if self.laws.values is None else self.laws.values.bounds
        with np.errstate(divide="ignore", invalid="ignore"):  # without springs, and unknown ones
            lengths = rest + values / stiffness
            angles = np.abs(lengths[:, tendons] / radii)
        is_far = np.any(np.isfinite(angles) & (angles > HALF_TURN), axis=0)
        is_alone = np.bincount(tendons)[tendons] == 1
        found = is_far & is_alone & np.array(self.hinges)
        return tuple(itertools.compress(self.attachment.names, found))

    def _lengths(self, frames: Frames, known: KnownCoordinates) -> Float[Array, " m"]:
        sides = self.attachment.sides(frames)
        turned, shifted = (sides.coordinate(hinge) for hinge in (True, False))
        read = jnp.where(np.array(self.hinges), turned, shifted)
        return self._sums(known.instead_of(read, self.attachment.names))

    def _sums(self, x: Float[Array, " k"]) -> Float[Array, " m"]:
        """Return the sums over the joints of each tendon, times the coefficients."""
        none = jnp.zeros((len(self.limited),), x.dtype)
        return none.at[np.array(self.tendons)].add(self.coefficients * x)


def tendon_loads(
    groups: tuple[JointGroup, ...],
    tendons: tuple[forces.Tendon, ...],
    names: tuple[str, ...],
    laws: SpringLaws,
) -> TendonLoads:
    advice = "Tendons go through `Revolute` and `Prismatic` joints."
    named = list(zip(tendons, names, strict=True))
    found, coefficients, limits = [], [], []
    for tendon, name in named:
        if not tendon.joints:
            raise ValueError(f"{name}: `joints` must name at least one hinge or slider.")
        found += [find_joint(groups, joint, name, advice) for joint in tendon.joints]
        given = check_shape(f"{name}: `coefficients`", tendon.coefficients, (len(tendon.joints),))
        coefficients += list(on_host(given))
        limits.append(_limits(tendon, name))
    lower, upper = (stack(side) for side in zip(*limits, strict=True))
    joint_names = tuple(joint for tendon in tendons for joint in tendon.joints)
    return TendonLoads(
        tuple(group.kind is joints.Revolute for group, _ in found),
        tuple(i for i, tendon in enumerate(tendons) for _ in tendon.joints),
        tuple(tendon.limits is not None for tendon in tendons),
        attachment_of(tuple(found), joint_names),
        stack(coefficients),
        laws,
        lower,
        upper,
    )


def _limits(tendon: forces.Tendon, name: str) -> list[Array]:
    """Return the least and the largest force, zeros for one without limits."""
    what = f"{name}: `limits` must be a pair of numbers or `None`"
    pair = (0.0, 0.0) if tendon.limits is None else as_pair(what, tendon.limits)
    lower, upper = (check_shape(f"{name}: `limits`", value, ()) for value in pair)
    if is_concrete(lower) and is_concrete(upper) and not lower <= upper:
        raise ValueError(
            f"{name}: `limits` must be in order, got {float(lower)} and {float(upper)}."
        )
    return [lower, upper]
