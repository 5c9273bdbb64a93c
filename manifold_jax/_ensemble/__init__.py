from .solution import EnsembleSolution as EnsembleSolution
from .solve_ensemble import solve_ensemble as solve_ensemble
from .store import open_ensemble as open_ensemble, StoredEnsemble as StoredEnsemble
from .stream_ensemble import stream_ensemble as stream_ensemble
