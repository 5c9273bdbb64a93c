"""Messages for points that could not be moved onto the manifold."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._base.rejection import is_finite
from .._base.types import Args, BoolScalar, IntScalar, RealScalarLike, Y
from .constraint import AbstractConstraint
from .projection_info import ProjectionInfo


NOT_THERE = 3  # number of the message for a state that may not be moved
NOT_FINITE = 4

_MESSAGES = (
    "`constraint` is not finite at the time and state given. Start from a state at which g(t, {y}, args) is "
    "defined.",
    "The Jacobian dg/dy of `constraint` does not have full rank at `{y}`: an equation ignores y, depends on the "
    "others (redundant), or `{y}` is a singular point. Remove dependent equations (or pass "
    "`redundant=True`), or start elsewhere.",
    "`{y}` could not be made consistent with `constraint`: no nearby state satisfies g(t, y, args) = 0. Start "
    "closer to the manifold, or check that the equations can hold at the same time.",
    '`{y}` is not on the manifold. Write `consistent="project"` to have it moved there, or correct it first with '
    "`mj.consistent_state`.",
    "`{y}` has numbers that are NaN or infinite. Start from a finite state.",
)


class Diagnosis(NamedTuple):
    """The number of the message that applies to a point, and all messages."""

    cause: IntScalar
    messages: tuple[str, ...]

    @staticmethod
    def of_start(
        constraint: AbstractConstraint, t: RealScalarLike, y: Y, args: Args, info: ProjectionInfo
    ) -> "Diagnosis":
        """Choose the message for a correction of `y` that failed with the report `info`."""
        # The residual is infinite for an equation that is scaled by a gradient of zero.
        cause = jnp.where(jnp.isnan(info.residual), 0, jnp.where(info.full_rank, 2, 1))
        cause = jnp.where(jnp.isinf(info.residual), 1, cause)
        messages = _MESSAGES
        for applies, message in constraint.faults(t, y, args):
            cause = jnp.where(applies, len(messages), cause)
            messages = (*messages, message)
        return Diagnosis(jnp.where(is_finite(y), cause, NOT_FINITE), messages)

    def raise_unless(self, success: BoolScalar, value: Any, name: str) -> Any:
        """Attach the error that names the cause to `value`; `name` is that of the state.

        For a batch the largest number is reported, so points without a fault must have the smallest.
        """
        messages = [message.format(y=name) for message in self.messages]
        cause = jnp.where(success, 0, self.cause)
        return eqx.branched_error_if(value, ~success, cause, messages)
