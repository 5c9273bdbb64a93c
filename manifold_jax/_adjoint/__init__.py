from .events import LocatingAdjoint as LocatingAdjoint
from .start import CheckedStartAdjoint as CheckedStartAdjoint
from .step_replay import StepReplayAdjoint as StepReplayAdjoint
