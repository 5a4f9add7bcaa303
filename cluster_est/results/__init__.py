"""What was found: estimates, errors and curves, as rows and tables."""
