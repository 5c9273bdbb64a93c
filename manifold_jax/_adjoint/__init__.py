from .step_replay import StepReplayAdjoint as StepReplayAdjoint
