from .lanes.solution import EnsembleSolution as EnsembleSolution
from .stored.store import open_ensemble as open_ensemble, StoredEnsemble as StoredEnsemble
