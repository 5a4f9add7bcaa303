"""Export of a run's findings: a repaired FMU, a parameter set, equations to read.

The repaired FMU is the original in a wrapper that adds the effects, as one archive: the wrapper is
a library of `workers.core`, `wrapper_table.py` writes what it reads, and `repaired_fmu.py` puts it
together.
"""
