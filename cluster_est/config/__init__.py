"""A TOML file, with all that it names, made into a problem, a method and settings."""
