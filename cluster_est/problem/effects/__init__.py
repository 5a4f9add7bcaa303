"""What is added to the model: effects, free curves, sensors, process noise."""
