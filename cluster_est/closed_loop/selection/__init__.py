"""Leading candidates simulated, refitted, accepted and revised: forward selection."""
