"""Standard errors from the derivatives at the solution, and what they leave open."""
