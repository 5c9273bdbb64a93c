"""Measurements and tables for the command line: solvers side by side, and the paper's Table 1.

A `Task` (task.py) is solved by every `Method` of the registry (methods.py; one file per library that
solves, and approaches.py for those of this one), which yields a `Measurement`; report.py and figure.py
show those.
"""
