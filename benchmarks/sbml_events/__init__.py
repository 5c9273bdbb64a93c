"""Cases with events of the SBML semantic test suite: `python -m benchmarks.sbml_events`."""
