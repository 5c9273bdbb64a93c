"""Equations of loops that do not depend on others, and motions that nothing with mass takes part in, from the
derivatives of both by the coordinates of joints."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from .assembly import Assembly
from .couplings import Couplings
from .rotors import names_of
from .start import dependence_of, DEPENDENT, refuse_dependent
from .system import ConstantAssembly
from .tree_checks import rank_of
from .tree_motion import TreeMotion
from .tree_system import Loops, TreeMass


def find_independent_loops(
    assembly: Assembly, motion: TreeMotion, q: Float[Array, " n"]
) -> tuple[int, ...] | None:
    """Return the numbers of as many equations of loops as are independent in the drawing, where the coordinates are
    `q`; `None` for all. That they are so elsewhere was found by `without_dependent_equations`."""
    groups, loops = assembly.joints, _passive_loops(assembly, motion)
    J = np.concatenate(_derivatives(motion, loops, assembly.couplings, q)[1])
    # Links without mass count as if they had some: equations that differ in their motions alone are independent.
    with_masses = assembly.bodies.with_masses()
    weighed = eqx.tree_at(lambda assembly: assembly.bodies, assembly, with_masses)
    mass = eqx.filter_jit(TreeMass(ConstantAssembly(weighed), motion.tree))(q, None)
    sizes, modes = np.linalg.eigh(mass)
    has_mass = sizes > DEPENDENT * sizes.max()
    weighted = J @ (modes[:, has_mass] / np.sqrt(sizes[has_mass]))
    lengths = np.linalg.norm(weighted, axis=1, keepdims=True)
    # Equations that hold whatever the coordinates are, such as those across the plane of a linkage, count as zero.
    dependence = dependence_of(J.dtype)
    has_size = lengths > dependence * lengths.max(initial=0)
    weighted = np.where(has_size, weighted / np.where(has_size, lengths, 1), 0)
    _, triangle, order = scipy.linalg.qr(weighted.T, mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
    pivots = np.abs(np.diagonal(triangle))
    number = int(np.sum(pivots > dependence * pivots.max(initial=0)))
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


def check_dependent_loops(assembly: Assembly, motion: TreeMotion, q: Float[Array, " n"]) -> None:
    """Refuse loops and couplings whose equations depend on each other where the coordinates are `q`."""
    loops = _passive_loops(assembly, motion)
    parts = _derivatives(motion, loops, assembly.couplings, q)[1]
    groups = *(group.attachment.names for group in loops.groups), assembly.couplings.names
    numbers, named = np.arange(sum(map(len, parts))), []
    for names, own in zip(groups, np.split(numbers, np.cumsum([*map(len, parts)])), strict=False):
        named += list(zip(names, own.reshape(len(names), -1), strict=True)) if names else []
    refuse_dependent(np.concatenate(parts), numbers, named)


def _passive_loops(assembly: Assembly, motion: TreeMotion) -> Loops:
    """Return the loops without drives, which are between them and the couplings."""
    passive = tuple(
        () if group.motions is not None else own
        for group, own in zip(assembly.joints, motion.tree.loops, strict=True)
    )
    return Loops.of(assembly.joints, motion.tree._replace(loops=passive))


def _check_couplings_with_loops(names: tuple[str, ...], rows: np.ndarray, rank: int) -> None:
    """Refuse couplings that depend on loops, or on each other, in the drawing: whether they do so elsewhere is
    not known."""
    if names and rank < rank_of(rows[: rows.shape[0] - len(names)]) + len(names):
        raise ValueError(
            f"`assembly`: in the drawing, the couplings {list(names)[:12]} depend on closed loops. Where they hold by "
            "themselves, leave them out; where this pose is special, draw the mechanism in another one."
        )


def check_light_motions(assembly: Assembly, motion: TreeMotion) -> None:
    """Refuse joints that can move bodies without mass while nothing with mass and no rotor moves: the accelerations
    would be unknown."""
    loops, n = Loops.of(assembly.joints, motion.tree), motion.coordinates.size
    # Not in the drawing, where axes may coincide by chance.
    q = jnp.sin(1.0 + jnp.arange(n, dtype=assembly.bodies.mass.dtype))
    bodies, parts = _derivatives(motion, loops, assembly.couplings, q)
    bodies, equations = np.asarray(bodies), np.concatenate(parts)
    heavy = bodies[np.asarray(assembly.bodies.mass) > 0]
    quaternions = motion.coordinates.quaternions()
    norms = np.zeros((len(quaternions), n))
    np.put_along_axis(norms, quaternions, np.asarray(q)[quaternions], axis=1)
    turned = np.eye(n)[motion.coordinates.numbers_of(names_of(assembly.rotors))]
    rows = np.concatenate([np.moveaxis(heavy, 1, 2).reshape(-1, n), equations, norms, turned])
    _, sizes, directions = np.linalg.svd(rows)
    unknown = directions[int(np.sum(sizes > DEPENDENT * sizes.max(initial=0))) :]
    if not unknown.size:
        return
    share = np.abs(unknown).max(axis=0)
    names = [column.name for column in motion.coordinates.columns]
    listed = [name for name, size in zip(names, share, strict=True) if size > 1e-3 * share.max()]
    raise ValueError(
        f"`assembly`: the joints {listed[:12]} can move bodies without mass while nothing with mass moves, such as two hinges "
        "about one axis. Give these bodies mass and inertia, or leave joints out."
    )


@eqx.filter_jit
def _derivatives(
    motion: TreeMotion, loops: Loops, couplings: Couplings, q: Float[Array, " n"]
) -> tuple[Float[Array, "b n 6"], tuple[Float[Array, "_ n"], ...]]:
    """Return those of velocities and angular velocities of bodies, and of the equations of loops and couplings, by
    the rates of `q`; those of each group of joints, and last of couplings."""
    at = motion.place(q)
    bodies = jnp.concatenate(motion.jacobians(at), axis=2)
    rows = loops.jacobian(at, bodies, some_hold=True)
    return bodies, (*rows, couplings.jacobian(motion.coordinates, q))
