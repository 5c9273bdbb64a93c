"""Parameters of equations on manifolds from measured data."""

from .fit import fit as fit
from .report import FitResult as FitResult
