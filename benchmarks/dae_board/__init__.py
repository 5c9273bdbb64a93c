"""A board of published differential-algebraic equations."""
