"""The Radau IIA method of order 5 for stiff equations and differential-algebraic equations."""

from .solver import RadauIIA5 as RadauIIA5, RadauState as RadauState
