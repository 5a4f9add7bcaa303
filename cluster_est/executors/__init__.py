"""Executors, which run tasks.

A new executor needs a file with a subclass of `WorkerPool`, and an entry in `EXECUTORS`. Executors
are imported only when they are used, because the import of Ray takes a second.
"""

from __future__ import annotations

from importlib import import_module

from cluster_est.executors.executor import Executor, WorkerPool

EXECUTORS = {
    "local": "cluster_est.executors.local:LocalExecutor",
    "processes": "cluster_est.executors.local:ProcessExecutor",
    "ray": "cluster_est.executors.ray_pool:RayPool",
}


def executor_class(name: str) -> type[WorkerPool]:
    """Import and return an executor by its name in a config."""
    module, _, attribute = EXECUTORS[name].partition(":")
    found: type[WorkerPool] = getattr(import_module(module), attribute)
    return found


__all__ = ["EXECUTORS", "Executor", "WorkerPool", "executor_class"]
