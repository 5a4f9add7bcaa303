"""The closed loop where noise acts on the states: what it does before and after a search."""
