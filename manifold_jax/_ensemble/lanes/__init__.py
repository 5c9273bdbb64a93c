"""Many trajectories at once: in the lanes of one loop, or mapped."""
