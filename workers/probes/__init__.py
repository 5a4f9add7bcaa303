"""Questions about an FMU that go beyond a simulation, for a preflight."""
