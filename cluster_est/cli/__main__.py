"""`python -m cluster_est.cli`, the same as `cluster-est`."""

from cluster_est.cli import run

if __name__ == "__main__":
    run()
