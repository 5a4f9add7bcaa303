"""Conversion of simulated outputs to residuals and constraints."""
