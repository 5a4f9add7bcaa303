"""Design of the next experiment: an input that discriminates rivals or narrows parameters.

Start with `design.design` and `limits.ExperimentLimits`.
"""
