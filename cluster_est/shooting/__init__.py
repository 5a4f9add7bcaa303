"""Multiple shooting: records in segments, each simulated from states that are estimated too."""
