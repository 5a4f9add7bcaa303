"""An FMU: its archive, what it says about itself, and one loaded instance."""
