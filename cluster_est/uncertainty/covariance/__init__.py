"""Standard errors from the derivatives at the solution, and directions without information."""
