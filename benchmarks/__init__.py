"""Benchmarks: programs to be run, `python -m benchmarks.overhead` and so on (see README.md)."""
