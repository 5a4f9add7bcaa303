"""The error of the solver's step beside what a fit has left."""
