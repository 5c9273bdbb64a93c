"""Leading derivatives that are in an equation other than linearly become states.

The equation that belongs to such a derivative is differentiated once more: then the next derivative
is the leading one, in which every equation is linear.
"""

import numpy as np

from .aliases import Aliases
from .equations import Equations
from .occurrence import nonlinear_unknowns, Point
from .signature import Structure


def lifted(equations: Equations, aliases: Aliases, structure: Structure, point: Point) -> Structure:
    """The structure with the fewest differentiations in which the equations with `c_i = 0`, too,
    are linear in the leading derivatives."""
    belongs_to = np.argsort(structure.transversal)
    while (found := _nonlinear(equations, aliases, structure, point)).any():
        at_least = structure.c.copy()
        at_least[belongs_to[found]] += 1
        raised = Structure.of(structure.sigma, at_least)
        assert raised is not None
        structure = raised
    return structure


def _nonlinear(
    equations: Equations, aliases: Aliases, structure: Structure, point: Point
) -> np.ndarray:
    """Of the leading derivatives, in equations that are not differentiated."""
    compact = np.searchsorted(aliases.roots, aliases.root)
    levels = structure.d[compact] - aliases.shift
    (unknowns,) = np.nonzero((levels >= 0) & (levels <= equations.order))
    depends = nonlinear_unknowns(equations, point, levels[unknowns], unknowns)
    there = depends[aliases.rows[structure.c == 0]].any(axis=0)
    found = np.zeros(len(structure.d), bool)
    found[compact[unknowns[there]]] = True
    return found
