"""What a run has found, written for others: a repaired FMU, a parameter set, equations to read."""
