"""Sensitivity analysis: the influence of unknowns on the data, and which can be estimated together.

Start with `analysis.analyse_sensitivity` and `settings.SensitivitySettings`.
"""
