"""The report of a reduction."""

import dataclasses

import numpy as np

from .._base.errors import listed
from .analysis import Analysis
from .signature import ABSENT


# Largest number of equations and unknowns for which the whole signature matrix is printed.
_MOST_PRINTED = 16


@dataclasses.dataclass(frozen=True, eq=False)
class DAEReport:
    """The structure of a [`ReducedDAE`][]; `print(dae.report)` shows it as a table.

    - `equations`, `unknowns`: names of the numbers in `F` and `x`.
    - `sigma`: the signature matrix, shape `(n, n)`: the highest derivative of each unknown in each
        equation, -1 where it is absent.
    - `c`, `d`: the offsets, `(n,)` each: how often each equation is differentiated, and up to which
        derivative each unknown then occurs.
    - `index`: the structural index, `max c`, and one more where an unknown is only found algebraically.
    - `degrees_of_freedom`: `sum d - sum c`, how many initial values are free.
    - `states`: names of the numbers of the state; `num_constraints` equations hold of them.
    - `dropped`: equations like `x' - v = 0`, which are solved by name.
    - `lifted`: unknowns that became states as an equation is a nonlinear function of them.
    - `condition`: the largest over the smallest singular value of the matrix of the leading
        derivatives, equilibrated, at the best of a few points near the example.
    - `fallbacks`: primitives of JAX without a rule for what depends on what, and how often they
        occur: of those everything counts as depending on everything, which is safe, but may cost
        differentiations.
    """

    equations: tuple[str, ...]
    unknowns: tuple[str, ...]
    sigma: np.ndarray
    c: np.ndarray
    d: np.ndarray
    index: int
    degrees_of_freedom: int
    states: tuple[str, ...]
    num_constraints: int
    dropped: tuple[str, ...]
    lifted: tuple[str, ...]
    condition: float
    fallbacks: dict[str, int]

    @staticmethod
    def of(analysis: Analysis) -> "DAEReport":
        names, layout, written = analysis.example.equations.names, analysis.layout, analysis.written
        raised = layout.aliases.roots[layout.structure.d > analysis.unlifted.d]
        best, states = max(analysis.samples.conditions), layout.names
        if analysis.implicit:
            states = np.concatenate([states, layout.leading_names()])
        return DAEReport(
            equations=names.equations,
            unknowns=names.unknowns,
            sigma=np.where(written.sigma == ABSENT, -1, written.sigma),
            c=written.c,
            d=written.d,
            index=written.index,
            degrees_of_freedom=written.degrees_of_freedom,
            states=tuple(names.derivative(unknown, k) for k, unknown in states.tolist()),
            num_constraints=int(analysis.c.sum()),
            dropped=tuple(names.equations[i] for i in layout.aliases.equations),
            lifted=tuple(names.unknowns[j] for j in raised),
            condition=1 / best if best > 0 else float("inf"),
            fallbacks=analysis.occurrence.unknown_primitives,
        )

    def __str__(self) -> str:
        n, lines = len(self.unknowns), []
        lines.append(
            f"index {self.index}, {_count(self.degrees_of_freedom, 'degree')} of freedom: {_count(n, 'equation')} "
            f"reduced to {_count(len(self.states), 'state')} with {_count(self.num_constraints, 'constraint')}"
        )
        if n <= _MOST_PRINTED:
            lines += ["", *self._matrix(), ""]
        else:
            lines.append(f"differentiated: {self._grouped()}")
        lines.append(f"state: {_listed(self.states)}")
        if self.dropped:
            lines.append(f"solved by name: {_listed(self.dropped)}")
        if self.lifted:
            lines.append(f"states, too, as equations are nonlinear in them: {_listed(self.lifted)}")
        lines.append(
            f"condition of the equations for the highest derivatives: {self.condition:.1e}"
        )
        if self.fallbacks:
            times = [f"{name} ({number})" for name, number in self.fallbacks.items()]
            lines.append(f"taken to depend on all of their inputs: {', '.join(times)}")
        return "\n".join(lines)

    def _matrix(self) -> list[str]:
        """Format the signature matrix with the offsets beside and below it."""
        sigma = np.where(self.sigma < 0, ".", self.sigma.astype(str))
        columns = [
            [name, *entries, str(d)]
            for name, entries, d in zip(self.unknowns, sigma.T.tolist(), self.d, strict=True)
        ]
        columns.append(["c", *map(str, self.c), ""])
        first = ["", *self.equations, "d"]
        padded = [[cell.ljust(max(map(len, first))) for cell in first]]
        padded += [[cell.rjust(max(map(len, column))) for cell in column] for column in columns]
        return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]

    def _grouped(self) -> str:
        groups: dict[int, list[str]] = {}
        for name, c in zip(self.equations, self.c.tolist(), strict=True):
            groups.setdefault(c, []).append(name)
        return "; ".join(f"{c} times {_listed(groups[c])}" for c in sorted(groups))


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return listed(list(names), most=8).replace("`", "")


def _count(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"
