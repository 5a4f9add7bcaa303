"""From simulated outputs to residuals: one file a kind."""
