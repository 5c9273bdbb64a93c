"""Rosenbrock methods for stiff equations and differential-algebraic equations of index 1."""

from .mass_matrix import MassMatrixTerm as MassMatrixTerm
from .mass_matrix_solver import AbstractMassMatrixSolver as AbstractMassMatrixSolver
from .solver import (
    AbstractRosenbrock as AbstractRosenbrock,
    Rodas3P as Rodas3P,
    Rodas5P as Rodas5P,
    RosenbrockState as RosenbrockState,
)
