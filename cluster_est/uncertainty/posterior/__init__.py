"""Draws from the posterior of the unknowns, and whether they can be trusted."""
