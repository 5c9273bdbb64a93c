"""Random problems, solved in many ways that must agree."""
