"""Functions shared by model exchange solvers: evaluation, events, forward sensitivities."""
