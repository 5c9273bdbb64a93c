"""What traced functions tell: which outputs depend on which inputs, and programs that run in lanes."""
