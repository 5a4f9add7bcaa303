"""The noise and the outliers of records."""
