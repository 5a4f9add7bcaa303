"""Joining a Ray cluster, or starting one on this machine alone."""

from __future__ import annotations

import contextlib
import logging
import os

import ray
from ray.exceptions import RayTaskError

from cluster_est.errors import ExecutorError, ModelError

LOCAL_STARTS = 3
"""Starts of Ray on this machine: it gives up after 15 seconds, too few where much else runs."""


def connect(workers: int | None, address: str | None) -> bool:
    """Join the cluster at an address, or start Ray here with as many cores as workers.

    Returns
    -------
    bool
        False if this process was connected already: then somebody else disconnects it.

    Raises
    ------
    ExecutorError
        If no cluster answers there, or Ray does not start here.
    """
    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    local = address in (None, "", "local")
    for left in reversed(range(LOCAL_STARTS if local else 1)):
        try:
            ray.init(
                address="local" if local else address,
                num_cpus=workers if local else None,
                include_dashboard=False if local else None,
                logging_level=logging.ERROR,
                log_to_driver=False,
            )
            break
        except Exception as error:  # a start that takes too long raises no class of its own
            disconnect()
            if not left:
                line = (str(error).splitlines() or [type(error).__name__])[0]
                raise ExecutorError(_not_connected(address, line, local=local)) from error
    return True


def _not_connected(address: str | None, line: str, *, local: bool) -> str:
    if local:
        return (
            f"executor: Ray did not start on this machine ({line}); try again when it is less "
            'busy, or set executor.name to "processes"'
        )
    return (
        f"executor.address: no Ray cluster answers at {address!r} ({line}); start one, or remove "
        "the key to use this machine"
    )


def disconnect() -> None:
    """Leave the cluster; stop Ray if `connect` started it."""
    ray.shutdown()


def cores() -> int:
    """Return the number of cores that the cluster has at the moment, at least one."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def why_not_started(error: Exception) -> Exception:
    """The model's own error where there is one, else a sentence around Ray's."""
    cause: BaseException | None = error
    with contextlib.suppress(AttributeError):
        cause = error.cause if isinstance(error, RayTaskError) else error
    if isinstance(cause, ModelError):
        return ModelError(str(cause))
    text = str(error)
    marker = "ModelError: "
    if marker in text:
        return ModelError(text.split(marker, 1)[1].splitlines()[0])
    line = (text.splitlines() or [type(error).__name__])[0]
    return ExecutorError(f"executor: the workers did not start ({line})")
