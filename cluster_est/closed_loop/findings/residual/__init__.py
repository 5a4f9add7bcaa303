"""What is left of the residual: noise, a disturbance, a column that varies with it."""
