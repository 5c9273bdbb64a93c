"""Assemblies that depend on the args of the solve."""

from collections.abc import Callable

import equinox as eqx

from .._base.types import Args
from .._base.user_functions import AbstractOfArgs, check_function
from .._mechanics import MechanicalSystem
from .assembly import Assembly
from .system import check_for_poses, system_of


def parametrized(build: Callable, *, redundant: bool = False) -> MechanicalSystem:
    """The system of an assembly that is built from the `args` of the solve, so that masses and
    geometry can be differentiated and fitted.

    ```python
    system = mj.multibody.parametrized(lambda args: mj.multibody.Assembly(...))
    sol = mj.diffeqsolve(system.terms, ..., y0, args={"mass": 2.0, "length": 0.3})
    ```

    **Arguments:**

    - `build`: `build(args)` returns an [`Assembly`][], with the same bodies and joints whatever the
        numbers are. Functions of forces get the same `args`.
    - `redundant`: as for [`Assembly`][]; needed here even where `build` says it.
    """
    check_function("build", build, "build(args)")
    return system_of(_Built(build, redundant), redundant)


class _Built(AbstractOfArgs):
    function: Callable
    redundant: bool = eqx.field(static=True)

    def __call__(self, args: Args) -> Assembly:
        assembly = self.function(args)
        if not isinstance(assembly, Assembly):
            raise TypeError(
                f"`build` must return an `mj.multibody.Assembly`, got {type(assembly).__name__}."
            )
        check_for_poses(assembly)
        if assembly.independent is not None:
            raise ValueError(
                "`build` returns an assembly of `without_dependent_equations`: write `parametrized(build, redundant=True)` with the "
                "assembly before, or replace its numbers by `eqx.tree_at` and take its `system` inside your function."
            )
        if assembly.redundant and not self.redundant:
            raise ValueError(
                "`build` returns an `Assembly(..., redundant=True)`: write `parametrized(build, redundant=True)`, too."
            )
        return assembly
