"""The equations of loops in the coordinates of joints that do not depend on others."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from .assembly import Assembly
from .couplings import Couplings
from .start import DEPENDENT
from .system import ConstantAssembly
from .tree_checks import rank_of
from .tree_motion import TreeMotion
from .tree_system import Loops, TreeMass


def find_independent_loops(
    assembly: Assembly, motion: TreeMotion, q: Float[Array, " n"]
) -> tuple[int, ...] | None:
    """Return the numbers of as many equations of loops as are independent in the drawing, where the coordinates are
    `q`; `None` for all. That they are so elsewhere was found by `without_dependent_equations`."""
    groups = assembly.joints
    passive = tuple(
        () if group.motions is not None else own
        for group, own in zip(groups, motion.tree.loops, strict=True)
    )
    loops = Loops.of(groups, motion.tree._replace(loops=passive))
    J = np.asarray(rows_of_loops(motion, loops, assembly.couplings, q))
    # Links without mass count as if they had some: equations that differ in their motions alone are independent.
    with_masses = assembly.bodies.with_masses()
    weighed = eqx.tree_at(lambda assembly: assembly.bodies, assembly, with_masses)
    mass = eqx.filter_jit(TreeMass(ConstantAssembly(weighed), motion.tree))(q, None)
    sizes, modes = np.linalg.eigh(mass)
    has_mass = sizes > DEPENDENT * sizes.max()
    weighted = J @ (modes[:, has_mass] / np.sqrt(sizes[has_mass]))
    lengths = np.linalg.norm(weighted, axis=1, keepdims=True)
    # Equations that hold whatever the coordinates are, such as those across the plane of a linkage, count as zero.
    has_size = lengths > DEPENDENT * lengths.max(initial=0)
    weighted = np.where(has_size, weighted / np.where(has_size, lengths, 1), 0)
    _, triangle, order = scipy.linalg.qr(weighted.T, mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
    pivots = np.abs(np.diagonal(triangle))
    number = int(np.sum(pivots > DEPENDENT * pivots.max(initial=1e-300)))
    _check_couplings_with_loops(assembly.couplings.names, weighted, number)
    if number == J.shape[0]:
        return None
    chosen = np.sort(order[:number])
    # The equations of drives, which are all solved, are between those of loops and couplings.
    drives = sum(len(group.attachment.names) for group in groups if group.motions is not None)
    norms = motion.coordinates.quaternions().shape[0]
    joints = J.shape[0] - len(assembly.couplings.names)
    of_loops, of_couplings = chosen[chosen < joints], chosen[chosen >= joints] + drives
    rest = J.shape[0] + drives + np.arange(norms)
    rows = [of_loops, joints + np.arange(drives), of_couplings, rest]
    return tuple(np.concatenate(rows).tolist())


def _check_couplings_with_loops(names: tuple[str, ...], rows: np.ndarray, rank: int) -> None:
    """Refuse couplings that depend on loops, or on each other, in the drawing: whether they do so elsewhere is
    not known."""
    if names and rank < rank_of(rows[: rows.shape[0] - len(names)]) + len(names):
        raise ValueError(
            f"`assembly`: in the drawing, the couplings {list(names)[:12]} depend on closed loops. Where they hold by "
            "themselves, leave them out; where this pose is special, draw the mechanism in another one."
        )


@eqx.filter_jit
def rows_of_loops(
    motion: TreeMotion, loops: Loops, couplings: Couplings, q: Float[Array, " n"]
) -> Float[Array, "m n"]:
    at = motion.place(q)
    rows = loops.jacobian(at, jnp.concatenate(motion.jacobians(at), axis=2))
    return jnp.concatenate([*rows, couplings.jacobian(motion.coordinates, q)])
