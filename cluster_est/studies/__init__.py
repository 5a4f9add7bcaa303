"""Studies, such as a fit, from Python, a config or a sweep."""
