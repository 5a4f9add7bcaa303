"""The design of the next experiment: the input that tells rivals apart, or narrows parameters.

`design.design` is where to begin, with `limits.ExperimentLimits`.
"""
