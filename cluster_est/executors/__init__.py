"""Executors: where tasks run. One file an executor.

A new executor is one file with a subclass of `WorkerPool` and one line here. They are imported only
when they are used, because Ray takes a second to import.
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
    """Import an executor by the name that the config calls it."""
    module, _, attribute = EXECUTORS[name].partition(":")
    found: type[WorkerPool] = getattr(import_module(module), attribute)
    return found


__all__ = ["EXECUTORS", "Executor", "WorkerPool", "executor_class"]
