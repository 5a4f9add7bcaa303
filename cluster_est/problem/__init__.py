"""The problem that is posed: model, parameters, constraints, measured data."""
