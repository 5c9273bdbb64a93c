from .reduce import reduce_dae as reduce_dae
from .report import DAEReport as DAEReport
from .system import ReducedDAE as ReducedDAE
