"""A polymer in space: beads on rigid bonds, as in molecular dynamics."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.types import RealScalarLike
from .._mechanics import MechanicalSystem
from ._problem import as_floating, Problem, repeated
from ._rods import allowed, Force, Rods, solve_rods


Beads: TypeAlias = Float[Array, "beads 3"]
State: TypeAlias = tuple[Beads, Beads]


class PolymerArgs(NamedTuple):
    """Parameters of `polymer` with N bonds: masses of the beads, shape `(N + 1,)`, lengths of the
    bonds, shape `(N,)`, and the stiffness in bending, an energy."""

    masses: Any
    lengths: Any
    stiffness: Any


def _mass(q: Beads, args: PolymerArgs) -> Beads:
    return jnp.broadcast_to(args.masses[:, None], q.shape)


def _bonds(t: RealScalarLike, q: Beads, args: PolymerArgs) -> Float[Array, " bonds"]:
    # Not as a sum over an axis, for which XLA would call a library.
    x, y, z = jnp.diff(q, axis=0).T
    return 0.5 * (x * x + y * y + z * z - args.lengths**2)


def _force(t: RealScalarLike, q: Beads, v: Beads, args: PolymerArgs) -> Beads:
    return _bending(jnp, q, args)


def _bending(xp: Any, q: Any, args: PolymerArgs) -> Any:
    """Return minus the gradient of `energy`, with bonds of constant length."""
    along = xp.diff(q, axis=0) / args.lengths[:, None]
    end = xp.zeros_like(along[:1])
    neighbours = xp.concatenate([end, along[:-1]]) + xp.concatenate([along[1:], end])
    pull = args.stiffness * neighbours / args.lengths[:, None]
    return xp.concatenate([end, pull]) - xp.concatenate([pull, end])


def energy(y: Any, args: PolymerArgs) -> Any:
    """Return kinetic and bending energy of a state of `polymer`, in NumPy."""
    q, v = y
    along = np.diff(q, axis=0) / np.asarray(args.lengths)[:, None]
    bending = args.stiffness * np.sum(1 - np.sum(along[1:] * along[:-1], axis=1))
    return 0.5 * np.sum(np.asarray(args.masses)[:, None] * v**2) + bending


def _initial_state(args: PolymerArgs, start: State) -> State:
    """Return the state for directions of bonds and their rates in `start`, with the lengths of `args`."""
    d, rate = jnp.diff(start[0], axis=0), jnp.diff(start[1], axis=0)
    stretch = (args.lengths / jnp.sqrt(jnp.sum(d * d, axis=1)))[:, None]
    ends = lambda first, links: jnp.cumsum(jnp.concatenate([first[:1], stretch * links]), axis=0)
    return ends(start[0], d), ends(start[1], rate)


def _exact(t: np.ndarray, args: PolymerArgs, y0: Any) -> tuple[np.ndarray, np.ndarray]:
    return solve_rods(rods(args), force(args), t, *y0)


def rods(args: PolymerArgs) -> Rods:
    """Return the rods for reference solutions."""
    bead = np.arange(args.lengths.size)
    return Rods.between(bead, bead + 1, 1 / args.masses)


def force(args: PolymerArgs) -> Force:
    """Return the force, in NumPy."""
    args = PolymerArgs(*(np.asarray(part) for part in args))
    return lambda q: _bending(np, q, args)


def polymer(
    bonds: int = 20,
    *,
    masses: Any = 1.0,
    lengths: Any = 1.0,
    stiffness: Any = 5.0,
    temperature: float = 1.0,
    seed: int = 0,
    t1: float = 1.0,
) -> Problem:
    r"""A polymer of N rigid bonds in space, free to move, of which the bonds resist bending: the
    problem of SHAKE and RATTLE in molecular dynamics, to be scaled up.

    N + 1 beads with $d_i = r_i - r_{i-1}$ and $u_i = d_i / L_i$, in any consistent units:

    $$m_i r_i'' = -\partial V / \partial r_i - \lambda_i d_i + \lambda_{i+1} d_{i+1}, \quad
    \tfrac12 (|d_i|^2 - L_i^2) = 0, \quad V = \kappa \sum_i (1 - u_i \cdot u_{i+1}).$$

    The state is `(q, v)` of shape `(N + 1, 3)` each; 2N constraints. The matrix $J M^{-1} J^T$ is
    tridiagonal. Energy, momentum and angular momentum are conserved but not enforced.

    The solution is an independent integration (SciPy's DOP853) of these equations with banded
    solves, not projected, to about 1e-12. The motion is chaotic: over long times no digits are left.

    **Arguments:**

    - `bonds`: their number N.
    - `masses` of the beads, a scalar or of shape `(N + 1,)`, `lengths` of the bonds, a scalar or of
        shape `(N,)`, and `stiffness` $\kappa$: `args`. `with_args` keeps the directions of the
        bonds and how they turn, also those of an initial state of yours.
    - `temperature`: of the start, an energy. Bonds are directed as in thermal equilibrium, and
        velocities random, without the part that would stretch bonds.
    - `seed`: of the random start.
    - `t1`: the end of the time span.

    Source: the model is that of Kratky & Porod, Recl. Trav. Chim. Pays-Bas 68 (1949) 1106-1122;
    Ryckaert, Ciccotti & Berendsen, J. Comput. Phys. 23 (1977) 327-341 (SHAKE); Andersen, J. Comput.
    Phys. 52 (1983) 24-34 (RATTLE).
    """
    masses, lengths = repeated(masses, bonds + 1, "masses"), repeated(lengths, bonds, "lengths")
    args = PolymerArgs(masses, lengths, as_floating(stiffness))
    start = _thermal(args, temperature, np.random.default_rng(seed))
    return Problem(
        "polymer",
        system=MechanicalSystem(_mass, _bonds, _force),
        t1=t1,
        args=args,
        start=tuple(jnp.asarray(part, args.masses.dtype) for part in start),
        initial_state=_initial_state,
        exact=_exact,
    )


def _thermal(
    args: PolymerArgs, temperature: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a thermal state of angles between bonds with the density `exp(-V / temperature)`."""
    masses, lengths, stiffness = (np.asarray(part, np.float64) for part in args)
    bonds = lengths.size
    stretch = max(float(stiffness) / temperature, 1e-8)
    uniform = random.uniform(size=bonds)
    cosine = 1 + np.log(uniform + (1 - uniform) * np.exp(-2 * stretch)) / stretch
    along = np.empty((bonds, 3))
    along[0] = 1.0, 0.0, 0.0
    for i in range(1, bonds):
        across = random.normal(size=3)
        across -= across @ along[i - 1] * along[i - 1]
        across *= np.sqrt(max(1 - cosine[i] ** 2, 0)) / np.linalg.norm(across)
        along[i] = cosine[i] * along[i - 1] + across
    q = np.concatenate([np.zeros((1, 3)), np.cumsum(lengths[:, None] * along, axis=0)])
    v = random.normal(size=(bonds + 1, 3)) * np.sqrt(temperature / masses)[:, None]
    return q, allowed(rods(PolymerArgs(masses, lengths, stiffness)), q, v)
