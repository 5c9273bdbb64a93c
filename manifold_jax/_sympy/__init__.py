"""Models of `sympy.physics.mechanics`: their vector field and their manifold. SymPy is imported by `from_sympy` alone.

- `compat.py`: what SymPy's methods hold under private names.
- `equations.py`: the equations of a method, and its symbols.
- `function.py`: expressions as functions of JAX.
- `constraint.py`: the manifold.
- `field.py`: the vector field, from a mass matrix and a forcing vector.
- `system.py`: what `from_sympy` returns. `convert.py`: `from_sympy`.
"""

from .convert import from_sympy as from_sympy
from .system import SymbolicSystem as SymbolicSystem
