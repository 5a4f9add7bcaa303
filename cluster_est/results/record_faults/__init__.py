"""Faults of records: a column with a wrong gain, a late clock, another unit, a foreign source."""
