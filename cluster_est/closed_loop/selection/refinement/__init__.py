"""Leading candidates simulated, and refitted with all parameters."""
