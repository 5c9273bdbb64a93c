"""Parameters of equations on manifolds, fitted to measured data."""

from .report import FitResult as FitResult
