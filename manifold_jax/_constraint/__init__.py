"""The constraint of a manifold, the correction onto it, and what is checked and measured of it."""
