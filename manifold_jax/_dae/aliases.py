"""Unknowns that are derivatives of others by an equation like `x' - v = 0`.

Such a `v` is the derivative `x'` under another name, and the equation needs neither to be
differentiated nor solved: `v'` is `x''`. Half of the equations of a first-order system are of this
kind.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .occurrence import Example, nonlinear_unknowns, Occurrence
from .signature import DAEStructure


class Aliases(NamedTuple):
    """Unknown `k` is `factor[k]` times derivative `shift[k]` of unknown `root[k]`. `equations` are
    those that only define an alias."""

    root: np.ndarray
    shift: np.ndarray
    factor: np.ndarray
    equations: np.ndarray

    @property
    def roots(self) -> np.ndarray:
        """The unknowns that are left."""
        return np.nonzero(self.root == np.arange(len(self.root)))[0]

    @property
    def columns(self) -> np.ndarray:
        """The place of the root of each unknown among those that are left."""
        return np.searchsorted(self.roots, self.root)

    @property
    def rows(self) -> np.ndarray:
        """The equations that are left."""
        return np.setdiff1d(np.arange(len(self.root)), self.equations)

    @staticmethod
    def of(example: Example, occurrence: Occurrence) -> "Aliases":
        n = example.equations.n
        root, shift, factor = np.arange(n), np.zeros(n, int), np.ones(n)
        used = []
        for row, (unknown, order), target, ratio in _candidates(example, occurrence):
            new = root[unknown] != target and root[target] == target
            if not new:  # a second equation for it, or a closed chain
                continue
            follows = root == target  # the target itself, and aliases of its derivatives
            shift[follows] += order + shift[unknown]
            factor[follows] *= ratio * factor[unknown]
            root[follows] = root[unknown]
            used.append(row)
        return Aliases(root, shift, factor, np.array(used, int))

    def merged(self, there: np.ndarray) -> np.ndarray:
        """Reduce a Boolean array `(equations, derivatives, unknowns)` to what is left of both."""
        n, levels = there.shape[1:][::-1]
        there = np.broadcast_to(there, (n, levels, n))
        if self.equations.size == 0:
            return there
        there = there[self.rows]
        out = np.zeros((len(there), levels + int(self.shift.max(initial=0)), n), bool)
        out[:, :levels] = there
        for k in np.setdiff1d(np.arange(n), self.roots):
            out[:, self.shift[k] : self.shift[k] + levels, self.root[k]] |= there[:, :, k]
        return out[:, :, self.roots]


def _candidates(example: Example, occurrence: Occurrence) -> list[Any]:
    """Return the equations `a x^(s) + b v = 0` with constants `a`, `b`: `(row, (x, s), v, -a / b)`."""
    there = occurrence.there
    constant = ~(
        occurrence.depends_on_time | occurrence.depends_on_args | occurrence.coefficients_vary
    )
    two = (there.sum(axis=(1, 2)) == 2) & (there[:, 0].sum(axis=1) == 1) & constant
    if not two.any():
        return []

    @jax.jit
    def sums(t: Any, args: Any) -> Any:
        """Return sums of the values at zero, of coefficients of derivatives, and of those of unknowns."""
        at = lambda *jets: example.residual(t, jets, args)
        zero, *higher = zeros = [jnp.zeros_like(x) for x in example.jets]
        values, a = jax.jvp(at, zeros, [zero, *map(jnp.ones_like, higher)])
        _, b = jax.jvp(at, zeros, [jnp.ones_like(zero), *higher])
        return values, a, b

    values, a, b = map(np.asarray, sums(example.t, example.args))
    found = []
    for row in np.nonzero(two & (values == 0) & (a != 0) & (b != 0))[0]:
        (order,), (unknown,) = np.nonzero(there[row, 1:])
        (target,) = np.nonzero(there[row, 0])[0]
        if target != unknown:
            found.append((row, (unknown, order + 1), target, -a[row] / b[row]))
    return found


def lifted(example: Example, aliases: Aliases, structure: DAEStructure) -> DAEStructure:
    """Return the structure with the fewest differentiations in which the equations with `c_i = 0`, too,
    are linear in the leading derivatives."""
    belongs_to = np.argsort(structure.transversal)
    while (found := nonlinear_derivatives(example, aliases, structure)).any():
        at_least = structure.c.copy()
        at_least[belongs_to[found]] += 1
        raised = DAEStructure.of(structure.sigma, at_least)
        assert raised is not None
        structure = raised
    return structure


def nonlinear_derivatives(
    example: Example, aliases: Aliases, structure: DAEStructure
) -> np.ndarray:
    """Return which leading derivatives occur nonlinearly in equations that are not differentiated."""
    levels = structure.d[aliases.columns] - aliases.shift
    (unknowns,) = np.nonzero((levels >= 0) & (levels <= example.equations.order))
    depends = nonlinear_unknowns(example, levels[unknowns], unknowns)
    there = depends[aliases.rows[structure.c == 0]].any(axis=0)
    found = np.zeros(len(structure.d), bool)
    found[aliases.columns[unknowns[there]]] = True
    return found
