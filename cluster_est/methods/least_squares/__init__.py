"""Levenberg-Marquardt within bounds, its linear algebra, and the one of SciPy."""
