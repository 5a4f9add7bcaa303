"""What is found out about an FMU before a run relies on it."""
