"""Benchmarks: programs to be run, `python -m benchmarks.speed.overhead` and so on (see README.md)."""
