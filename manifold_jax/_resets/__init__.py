"""Resets: jumps of the state at events and at known times."""
