from .solution import EnsembleSolution as EnsembleSolution
from .store import open_ensemble as open_ensemble, StoredEnsemble as StoredEnsemble
