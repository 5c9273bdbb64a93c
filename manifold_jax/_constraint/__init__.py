"""Constraints, the correction onto their manifold, checks of arguments and measures of violation."""
