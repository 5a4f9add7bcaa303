"""Conversion of a TOML file and the files that it names to a problem, a method and settings."""
