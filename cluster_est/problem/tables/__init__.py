"""Measured tables, in files or in memory, as checked signals of an experiment."""
