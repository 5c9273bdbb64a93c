from .events import LocatingAdjoint as LocatingAdjoint
from .step_replay import StepReplayAdjoint as StepReplayAdjoint
