"""Ball joints, which URDF does not have: files give three hinges through one point, with links without
mass between them."""

from collections.abc import Collection, Mapping

import numpy as np

from .kinematic_tree import from_root
from .urdf_elements import BALL, Joint, Link


_ROUNDING = 1e-6  # m


def merge_hinges(
    links: Mapping[str, Link], joints: list[Joint], kept: Collection[str]
) -> tuple[dict[str, Link], list[Joint]]:
    """Return links and joints with three such hinges as one ball joint, with the names of all three; the
    links between them are left out. `kept` are links and joints that are needed elsewhere.

    Three angles have a pose in which two of the axes are parallel, where a loop could not be closed.
    """
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)

    def next_hinge(joint: Joint) -> Joint | None:
        """Return the hinge after this one, if nothing but a link without mass is between them."""
        own = children.get(joint.child, [])
        free = links[joint.child].mass == 0 and joint.child not in kept
        alone = free and len(own) == 1 and _is_hinge(own[0], kept)
        return own[0] if alone and np.linalg.norm(own[0].origin.origin) < _ROUNDING else None

    remaining, found, merged = dict(links), [], set()
    for first in from_root(links, joints)[1]:  # so that a chain begins with its first hinge
        if first.name in merged:
            continue
        second = next_hinge(first) if _is_hinge(first, kept) else None
        third = None if second is None else next_hinge(second)
        if second is None or third is None or not _spans(first, second, third):
            found.append(first)
            continue
        merged |= {second.name, third.name}
        del remaining[first.child], remaining[second.child]
        found.append(
            first._replace(
                name=f"{first.name} {second.name} {third.name}",
                kind=BALL,
                child=third.child,
                limits=None,
                rest=second.origin.then(third.origin),
            )
        )
    return remaining, found


def _is_hinge(joint: Joint, kept: Collection[str]) -> bool:
    turns = joint.kind in ("revolute", "continuous")
    return turns and joint.name not in kept and joint.damping == 0


def _spans(first: Joint, second: Joint, third: Joint) -> bool:
    """Whether the axes of the hinges are not always in one plane: the second is neither parallel to the
    first nor to the third."""
    across = lambda a, b: np.linalg.norm(np.cross(a, b)) > 1e-3
    inner = third.origin.rotation @ third.axis
    return bool(
        across(first.axis, second.origin.rotation @ second.axis) and across(second.axis, inner)
    )
