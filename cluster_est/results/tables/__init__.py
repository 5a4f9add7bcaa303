"""The tables of a run: their columns, the types of their rows, and how they are shown."""
