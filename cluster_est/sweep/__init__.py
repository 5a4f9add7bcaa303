"""Sweeps: many runs from one file, which can be continued."""
