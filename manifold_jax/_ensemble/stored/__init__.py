"""Ensembles in a folder on disk: their arrays, their faults and their lock."""
