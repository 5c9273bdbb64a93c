"""Checks of assemblies and states in the coordinates of joints."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .assembly import Assembly
from .checks import is_concrete
from .couplings import Couplings
from .joint_groups import bodies_of
from .rotors import names_of
from .spanning_tree import SpanningTree
from .start import CLOSED, DEPENDENT
from .tree_coordinates import TreeCoordinates


def check_masses(assembly: Assembly, tree: SpanningTree, coordinates: TreeCoordinates) -> None:
    """Refuse bodies without mass at ends of the tree, which any force would accelerate without bound: those that
    move nothing with mass, and that no loop, drive, coupling or rotor holds."""
    if not is_concrete(assembly.bodies.mass):
        return
    pairs = zip(assembly.joints, tree.loops, strict=True)
    loops = [bodies_of((group,))[:, list(own)].reshape(-1) for group, own in pairs]
    fixed = np.append(np.asarray(assembly.bodies.mass) > 0, True)
    fixed[np.concatenate([np.zeros(0, int), *loops])] = True
    is_fixed = np.any(tree.is_moved() & fixed[:-1, None], axis=0)
    held = names_of(assembly.rotors) + assembly.couplings.joints + assembly.couplings.others
    columns = coordinates.columns
    free = [c.body for c in columns if not is_fixed[c.body] and c.name not in held]
    if free:
        names = [assembly.names[i] for i in dict.fromkeys(free)]
        raise ValueError(
            f"`assembly`: the bodies {names[:12]} have no mass and move none that has. Give them mass and inertia, or "
            "weld them by `Fixed` joints."
        )


def check_cycles(assembly: Assembly, coordinates: TreeCoordinates) -> None:
    """Refuse couplings that depend on each other."""
    couplings = assembly.couplings
    if not couplings.names or not is_concrete(couplings.coefficients):
        return
    rows = couplings.jacobian(coordinates, jnp.zeros(coordinates.size))
    if rank_of(np.asarray(rows)) < len(couplings.names):
        raise ValueError(
            f"`assembly`: the couplings {list(couplings.names)[:12]} depend on each other: each must couple a joint that no "
            "other ones couple to the same joints."
        )


def check_couplings(couplings: Couplings, coordinates: TreeCoordinates, q: Array, v: Array) -> None:
    """Refuse coordinates and rates for which couplings do not hold."""
    if not couplings.names:
        return
    rates = couplings.jacobian(coordinates, q) @ v
    for what, rows in (("", couplings.residual(coordinates, q)), ("rates of ", rates)):
        gap = np.abs(np.asarray(rows))
        if not gap.max() <= 10 * CLOSED * max(1, np.abs(q).max(), np.abs(v).max()):
            raise ValueError(
                f"`y`: the coupling {couplings.names[int(gap.argmax())]!r} does not hold for the {what}coordinates (gap "
                f"{gap.max():.3g}). Change the coordinates `(q, v)`, of which `names` has the names, instead of the poses; "
                "from these, angles are between -pi and pi."
            )


def rank_of(rows: np.ndarray) -> int:
    """Return the number of independent rows."""
    return int(np.linalg.matrix_rank(rows, rtol=DEPENDENT)) if rows.size else 0
