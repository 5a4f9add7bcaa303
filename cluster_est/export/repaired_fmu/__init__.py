"""The repaired FMU: the original in a wrapper that adds the effects, as one archive."""
