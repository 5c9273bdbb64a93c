"""Comparisons with other programs: state error, violation and time, in one run."""
