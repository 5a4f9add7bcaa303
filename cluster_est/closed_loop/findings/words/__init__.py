"""What was found in the words of physics, where the units say so; else in those of mathematics."""
