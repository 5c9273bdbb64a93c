"""An assembly as a mechanical system, whether it is there already or built from the args of the solve."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from .._base.types import Args, RealScalarLike
from .._mechanics import AbstractPositions, MechanicalSystem
from .bodies import Pose


class ConstantAssembly(eqx.Module):
    assembly: Any

    def __call__(self, args: Args) -> Any:
        return self.assembly


class _Mass(eqx.Module):
    source: Callable

    def __call__(self, q: Pose, args: Args) -> Any:
        return self.source(args).bodies.mass_matrix(q)


class _Joints(AbstractPositions):
    source: Callable

    def __call__(self, t: RealScalarLike, q: Pose, args: Args) -> tuple[Array, ...]:
        return self.source(args)._equations(t, q, args)

    def jacobian(self, t: RealScalarLike, q: Pose, args: Args) -> Float[Array, "m n"]:
        return self.source(args)._jacobian(t, q, args)


class _Forces(eqx.Module):
    source: Callable

    def __call__(self, t: RealScalarLike, q: Pose, v: Pose, args: Args) -> Pose:
        return self.source(args)._force(t, q, v, args)


def system_of(source: Callable, redundant: bool) -> MechanicalSystem:
    return MechanicalSystem(_Mass(source), _Joints(source), _Forces(source), redundant=redundant)
