"""The command line: arguments, commands, and everything that prints."""

from cluster_est.cli.entry_point import main, run

__all__ = ["main", "run"]
