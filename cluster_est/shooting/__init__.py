"""Multiple shooting: records in segments, with estimated initial states of each segment."""
