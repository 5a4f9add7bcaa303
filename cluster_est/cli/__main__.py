"""`python -m cluster_est.cli`, the same as `cluster-est`."""

from cluster_est.cli.entry_point import run

run()
