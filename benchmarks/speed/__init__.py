"""What this package costs: compile time, run time, gradients, sizes."""
