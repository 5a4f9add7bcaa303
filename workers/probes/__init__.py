"""Probes: questions about an FMU, beyond a simulation, for the preflight checks."""
