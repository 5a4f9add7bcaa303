"""The systems of the benchmark, a file for each field of engineering."""
