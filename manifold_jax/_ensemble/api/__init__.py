"""`solve_ensemble` and `stream_ensemble`: what users call for many trajectories."""
