"""What `bench_peers.py` runs: one problem, and the ways to solve it."""
