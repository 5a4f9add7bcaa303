"""Export of a run's results: a repaired FMU, a parameter set, or equations as text.

The repaired FMU contains the original in a wrapper that adds the effects. The wrapper is a library
of `workers.core`, `wrapper_table.py` writes the file that it reads, and `repaired_fmu.py` assembles
the archive.
"""
