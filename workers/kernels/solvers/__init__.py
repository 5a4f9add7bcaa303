"""The solvers: one batch function each."""
