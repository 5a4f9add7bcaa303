"""Searches, their simulations and their budget: one queue for all of them."""
