"""Export of a run's findings: a repaired FMU, a parameter set, equations to read."""
