"""Analysis of traced functions: which outputs depend on which inputs, and evaluation in lanes."""
