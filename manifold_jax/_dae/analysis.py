"""The structural analysis of a system, before it is evaluated."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._base.types import Args
from .._linalg.sparse import SMALLEST, Sparsity, sparsity_of_any, SquarePattern
from .aliases import Aliases, lifted, nonlinear_derivatives
from .block_elimination import Elimination
from .compressed import Compressed
from .derivatives import pick, total_derivatives
from .equations import ResidualEquations
from .layout import StateLayout
from .occurrence import Example, Occurrence
from .samples import Samples
from .signature import DAEStructure, signature


@dataclasses.dataclass(frozen=True, eq=False)
class Analysis:
    """Structure, aliases, layout and elimination of a system. Compared by identity.

    - `written`: the structure of all equations.
    - `unlifted`: that of the equations that are left, with the fewest differentiations.
    - `implicit`: whether these may be nonlinear in the leading derivatives.
    """

    example: Example
    occurrence: Occurrence
    written: DAEStructure
    unlifted: DAEStructure
    layout: StateLayout
    entries: Compressed
    implicit: bool

    @staticmethod
    def of(example: Example, occurrence: Occurrence, implicit: bool) -> "Analysis | None":
        """Analyse equations; return `None` if the structure is singular."""
        written = DAEStructure.of(signature(occurrence.there))
        if written is None:
            return None
        aliases, order = Aliases.of(example, occurrence), example.equations.order
        there = aliases.merged(occurrence.there)
        unlifted = DAEStructure.of(signature(there))
        assert unlifted is not None
        structure = unlifted if implicit else lifted(example, aliases, unlifted)
        layout = StateLayout.of(structure, aliases, order)
        entries = Compressed.of(structure, aliases, there, order + 1)
        return Analysis(example, occurrence, written, unlifted, layout, entries, implicit)

    @property
    def c(self) -> np.ndarray:
        """The number of differentiations of each of the equations that are left."""
        return self.layout.structure.c

    @property
    def rows(self) -> np.ndarray:
        """The equations that are left."""
        return self.layout.aliases.rows

    @functools.cached_property
    def controlled(self) -> np.ndarray:
        """Which numbers of the state of the form of index 1 count in the error of a step: not the derivatives in
        which the equations are linear. What these are wrong by shows in what they are derivatives of."""
        order, _ = self.layout.leading_names().T
        nonlinear = nonlinear_derivatives(self.example, self.layout.aliases, self.layout.structure)
        states = np.ones(self.layout.num_states, bool)
        return np.concatenate([states, (order == 0) | nonlinear])

    @functools.cached_property
    def samples(self) -> Samples:
        states = self.layout.num_states

        def entries(t: Array, y: Array, args: Args) -> Array:
            jets = self.jets(y[:states], y[states:] if self.implicit else None, 0)
            derivatives = self.entries.derivatives(self.example.residual, t, jets, args)
            return self.entries.values(derivatives)

        return Samples.of(jax.jit(entries), self.entries.places, self.example, self.layout)

    @functools.cached_property
    def elimination(self) -> Elimination:
        structure = self.layout.structure
        level = np.maximum(structure.sigma, 0)[:, None, :]
        varies = self.layout.aliases.merged(self.occurrence.varies)
        varies = np.take_along_axis(varies, level, axis=1)[:, 0]
        return Elimination.of(structure.leading & ~varies, self.samples.matrices)

    @functools.cached_property
    def sparsity(self) -> Sparsity | None:
        """How the equations for the leading derivatives are solved if these are many; `None` for
        dense matrices."""
        if len(self.elimination.other_rows) < SMALLEST:
            return None
        places, dtype = self.entries.places, self.example.jets[0].dtype
        return sparsity_of_any(SquarePattern(sp.csr_matrix(places)), dtype)

    def jets(
        self, z: Float[Array, " a"], w: Float[Array, " b"] | None, differentiations: int
    ) -> tuple[Float[Array, " n"], ...]:
        """Return the derivatives of all unknowns that occur in the equations differentiated up to this
        order; zero for those that are unknown."""
        number = self.example.equations.order + 1 + differentiations
        return tuple(self.layout.jet(k)(z, w) for k in range(number))

    def jets_of_states(
        self, z: Float[Array, " a"], w: Float[Array, " b"] | None, differentiations: int
    ) -> tuple[Array, ...]:
        """Return the derivatives for equations of states alone. The others, evaluated with them, have
        to stay finite, and of moderate size where they cancel: for unknowns that are not states use
        those in `w`, without derivatives, or the example."""
        x, *others = self.jets(z, None, differentiations)
        known = self.layout.jet(0).index
        known = (known >= 0) & (known < self.layout.num_states)
        rest = jnp.asarray(self.example.jets[0], x.dtype)
        if w is not None:
            rest = self.layout.jet(0)(jnp.zeros_like(z), jax.lax.stop_gradient(w))
        return jnp.where(known, x, rest), *others

    def differentiated(
        self,
        equations: ResidualEquations,
        t: Array,
        jets: tuple[Array, ...],
        args: Args,
        first: np.ndarray | int,
        end: np.ndarray,
    ) -> Float[Array, " m"]:
        """Return `F_i^(k)` for `first_i <= k < end_i`, lower derivatives first."""
        number = int(end.max(initial=1))
        levels = total_derivatives(equations, t, jets, args, number - 1)
        parts = [pick(levels[k], self.rows[(first <= k) & (k < end)]) for k in range(number)]
        return jnp.concatenate(parts)
