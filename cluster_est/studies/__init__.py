"""Studies: what users ask for, from Python, a config or a sweep."""
