"""Parameters of equations on manifolds from measured data."""

from .report import FitResult as FitResult
