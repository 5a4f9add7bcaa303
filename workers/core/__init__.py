"""The core: simulation loops, effects and filters in C, called by ctypes."""
