"""Results: estimates, errors and curves, as rows and tables."""
