"""What the solvers share that integrate an FMU: moving it, its events, its sensitivities."""
