"""Couplings of hinges and sliders, all together: coordinates that are polynomials in others."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import joints
from .attachment import name_all
from .checks import check_shape, on_host, stack
from .joint_groups import find_joint, JointGroup
from .tree_coordinates import TreeCoordinates


class Couplings(eqx.Module):
    """The equations `x - c_1 z - c_2 z^2 - ... = 0` of `k` couplings: the joints of `x` and of `z`, and the
    coefficients `(k, d)`, filled up by zeros."""

    names: tuple[str, ...] = eqx.field(static=True)
    joints: tuple[str, ...] = eqx.field(static=True)
    others: tuple[str, ...] = eqx.field(static=True)
    coefficients: Float[Array, "k d"]

    def residual(self, coordinates: TreeCoordinates, q: Float[Array, " n"]) -> Float[Array, " k"]:
        x, z = self._numbers(coordinates)
        return q[x] - self._polynomial(q[z], 0)

    def jacobian(self, coordinates: TreeCoordinates, q: Float[Array, " n"]) -> Float[Array, "k n"]:
        (x, z), own = self._numbers(coordinates), np.arange(len(self.names))
        rows = jnp.zeros((own.size, q.size), q.dtype).at[own, x].set(1)
        return rows.at[own, z].add(-self._polynomial(q[z], 1))

    def bias(
        self,
        coordinates: TreeCoordinates,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
    ) -> Float[Array, " k"]:
        """Return the second time derivatives of the residuals where the accelerations of `q` are zero."""
        _, z = self._numbers(coordinates)
        return -self._polynomial(q[z], 2) * v[z] ** 2

    def _numbers(self, coordinates: TreeCoordinates) -> tuple[np.ndarray, np.ndarray]:
        return coordinates.numbers_of(self.joints), coordinates.numbers_of(self.others)

    def _polynomial(self, z: Float[Array, " k"], order: int) -> Float[Array, " k"]:
        """Return a derivative of the polynomials, by Horner's scheme."""
        found, coefficients = jnp.zeros_like(z), self.coefficients.astype(z.dtype)
        for power in range(coefficients.shape[1], max(order, 1) - 1, -1):
            found = found * z + math.perm(power, order) * coefficients[:, power - 1]
        return found * z if order == 0 else found


def group_couplings(groups: tuple[JointGroup, ...], given: Any) -> Couplings:
    named = [
        (coupling, name)
        for coupling, name in name_all(given, joints.AbstractRestraint, "joint")
        if isinstance(coupling, joints.Coupling)
    ]
    advice = "Couplings are of `Revolute` and `Prismatic` joints."
    for coupling, name in named:
        for joint in (coupling.joint, coupling.other):
            find_joint(groups, joint, name, advice)
        if coupling.joint == coupling.other:
            raise ValueError(
                f"{name} couples {coupling.joint!r} with itself. Give two joints; one that does not move has a `Drive`."
            )
    rows = [_coefficients(coupling, name) for coupling, name in named]
    longest = max((row.size for row in rows), default=1)
    filled = [jnp.pad(row, (0, longest - row.size)) if row.size < longest else row for row in rows]
    return Couplings(
        tuple(name for _, name in named),
        tuple(coupling.joint for coupling, _ in named),
        tuple(coupling.other for coupling, _ in named),
        stack(filled) if filled else jnp.zeros((0, 1)),
    )


def _coefficients(coupling: joints.Coupling, name: str) -> Any:
    """Return the coefficients as a vector."""
    given = coupling.coefficients
    number = len(given) if isinstance(given, tuple | list) else np.size(given)
    given = check_shape(f"{name}: `coefficients`", given, (), (max(1, number),))
    return on_host(given).reshape(-1)
