"""Statistics of residuals: records, noise, and tests for structure."""
