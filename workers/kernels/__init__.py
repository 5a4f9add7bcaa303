"""The compiled inner loops: one batch function for each way to integrate an FMU."""
