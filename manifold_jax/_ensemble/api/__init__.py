"""The front ends for many trajectories: `solve_ensemble` and `stream_ensemble`."""
