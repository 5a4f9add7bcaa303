"""Simulation of an experiment with an FMU and effects."""
