"""Residuals as stacked records, their noise, and tests of what is left in them."""
