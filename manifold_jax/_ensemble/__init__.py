from .solution import EnsembleSolution as EnsembleSolution
from .solve_ensemble import solve_ensemble as solve_ensemble
