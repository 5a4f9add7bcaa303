"""Shapes of effects: the added term of each effect over its argument, in the range of the data."""
