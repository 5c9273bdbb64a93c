r"""Coefficients of the Radau IIA method with three stages (Hairer & Wanner, Solving ODEs II, IV.5 and
IV.8), all from its nodes.

The stages are $y_0 + Z_i$ at $t_0 + c_i h$. A polynomial of degree three through $y_0$ and the stages
satisfies the equations there; with its derivatives $V_i / h$, $Z = A V$.
"""

import numpy as np


_ROOT = 6**0.5
C = np.array([(4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0])


def _integrals() -> np.ndarray:
    """Return `A`: integrals of the Lagrange polynomials of the nodes from 0 to each node."""
    powers = np.arange(1, 4)
    return (C[:, None] ** powers / powers) @ np.linalg.inv(np.vander(C, 3, increasing=True))


A_INVERSE = np.linalg.inv(_integrals())


def _decoupled() -> tuple[float, complex, np.ndarray]:
    r"""Return the eigenvalues $\gamma$ and $\mu = \alpha + i \beta$ of $A^{-1}$, and `T` with
    $T^{-1} A^{-1} T = \mathrm{diag}(\gamma, \begin{pmatrix} \alpha & -\beta \\ \beta & \alpha
    \end{pmatrix})$ (IV.8.5)."""
    values, vectors = np.linalg.eig(A_INVERSE)
    real, other = np.argmin(np.abs(np.imag(values))), np.argmax(np.imag(values))
    pair = vectors[:, other]
    T = np.stack([np.real(vectors[:, real]), np.real(pair), -np.imag(pair)], axis=1)
    return float(np.real(values[real])), complex(values[other]), T


GAMMA, MU, T = _decoupled()
T_INVERSE = np.linalg.inv(T)

# Weights of the stages in the embedded error estimate of order 3 (IV.8.19), divided by `1 / GAMMA`.
ERROR = np.array([-13 - 7 * _ROOT, -13 + 7 * _ROOT, -1]) / 3


def _bumps() -> np.ndarray:
    """Return the rows of `k_1` and `k_2` in `(1 - s) y_0 + s (y_1 + (1 - s) (k_1 + s k_2))`, which is
    `y_0 + Z_i` at the nodes."""
    c1, c2 = C[:2]
    first, second = ([[1, 0, -c1]] / (c1 * (1 - c1)))[0], ([[0, 1, -c2]] / (c2 * (1 - c2)))[0]
    slope = (second - first) / (c2 - c1)
    return np.stack([first - c1 * slope, slope])


DENSE = _bumps()
