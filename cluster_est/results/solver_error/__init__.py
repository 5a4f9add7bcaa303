"""The error of the solver, compared with the residuals of a fit."""
