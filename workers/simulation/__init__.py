"""An experiment, an FMU and effects, bound together and simulated."""
