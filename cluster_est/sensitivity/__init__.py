"""Sensitivity analysis: which unknowns matter, where in the data, and which go together.

`analysis.sensitivity` is where to begin, with `settings.SensitivitySettings`.
"""
