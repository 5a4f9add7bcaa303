"""Numerical error: what the solver and its steps add to a residual, which no effect may explain."""
