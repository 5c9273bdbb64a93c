"""From the residuals of a DAE to a vector field on a manifold, by Pryce's structural analysis.

A pendulum, `F(t, x, x', args)` with the unknowns `x, y, u, v, lambda`, as an example:

    A: x' - u = 0                C: u' + lambda x = 0            E: x^2 + y^2 - 1 = 0
    B: y' - v = 0                D: v' + lambda y + g = 0

- `equations.py`, `occurrence.py`: which derivative of which unknown occurs in which equation, found
  from the function. The signature matrix has the highest ones (`-` where an unknown is absent):

          x  y  u  v  lambda   c
      A   1  -  0  -    -      1
      B   -  1  -  0    -      1
      C   0  -  1  -    0      0
      D   -  0  -  1    0      0
      E   0  0  -  -    -      2
      d   2  2  1  1    0

- `signature.py`: the smallest offsets with `d_j - c_i >= sigma_ij`: A and B are differentiated once, E
  twice, which leaves sum(d) - sum(c) = 2 degrees of freedom; the index is 3.
- `aliases.py`, `combined.py`: unknowns that are derivatives of others under another name, and combinations
  of equations whose derivatives cancel; both are eliminated before the analysis.
- `layout.py`: which derivatives are states, and where each number is. `analysis.py` has all of this.
- `compressed.py`, `samples.py`, `block_elimination.py`: the matrix of the leading derivatives, whether it is
  nonsingular (`condition.py` of `_linalg`), and the pivots that are eliminated beforehand.
- `highest_derivatives.py`: the linear equations for `x'', y'', u', v', lambda`: the vector field.
- `reduced.py`: the field of the state, and E with its first derivative and A, B where they are not
  eliminated: the manifold.
- `initial.py`, `nearest.py`: consistent starts. `system.py`, `report.py`: what `reduce_dae` returns.
"""

from .reduce import reduce_dae as reduce_dae
from .report import DAEReport as DAEReport
from .system import ReducedDAE as ReducedDAE
