"""Sequential quadratic programming, and constrained minimisers of SciPy."""
