"""The space that methods search: unknowns, and what counts beside the experiments' residuals."""
