"""`python -m cluster_est` is the command `cluster-est`."""

from cluster_est.cli import run

if __name__ == "__main__":
    run()
