"""An FMU: its archive, its model description, and a loaded instance."""
