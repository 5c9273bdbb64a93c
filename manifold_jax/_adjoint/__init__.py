from .checked_start import CheckedStartAdjoint as CheckedStartAdjoint
from .events import LocatingAdjoint as LocatingAdjoint
from .step_replay import StepReplayAdjoint as StepReplayAdjoint
