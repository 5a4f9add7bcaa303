"""What is to be estimated, from what: model, parameters, constraints, measured data."""
