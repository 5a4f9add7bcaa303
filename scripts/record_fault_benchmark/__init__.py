"""The benchmark of faults of records: sets of records with one thing wrong in one or in all."""
