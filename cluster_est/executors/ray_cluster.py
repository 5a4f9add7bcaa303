"""Joining a Ray cluster, or starting one on this machine alone."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import ray
from ray.exceptions import RayTaskError

from cluster_est.errors import ExecutorError, ModelError
from cluster_est.executors.ray_answer import why_not_joined

_PACKAGES = Path(__file__).parents[2]
"""The folder of this package and `workers`, which Ray's workers import from in any case."""
_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_started_in: list[str] = []
"""The folder of this program when it started Ray; nothing without a Ray of its own."""

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
    if not local and (reason := why_not_joined(str(address))):
        raise ExecutorError(f"executor.address: {reason}")
    for left in reversed(range(LOCAL_STARTS if local else 1)):
        try:
            with _away_from_the_users_files() as folder, _alone(local):
                ray.init(
                    address="local" if local else address,
                    num_cpus=workers if local else None,
                    include_dashboard=False if local else None,
                    logging_level=logging.ERROR,
                    log_to_driver=False,
                )
            if local:
                _started_in[:] = [folder]
                _close_token_to_others()
            break
        except Exception as error:  # a start that takes too long raises no class of its own
            disconnect()
            if not left:
                line = (str(error).splitlines() or [type(error).__name__])[0]
                raise ExecutorError(_not_connected(address, line, local=local)) from error
    return True


@contextlib.contextmanager
def _away_from_the_users_files() -> Iterator[str]:
    """Work in a folder without files of the user, and come back; gives the folder before.

    Ray has its workers import from the folder that it is started or joined in before all others: a
    numpy.py that is there would be executed.
    """
    try:
        before = os.getcwd()
    except OSError:  # it has been removed
        before = ""
    os.chdir(_PACKAGES)
    try:
        yield before
    finally:
        if before:
            os.chdir(before)


@contextlib.contextmanager
def _alone(local: bool) -> Iterator[None]:
    """Have a Ray that is started here listen to this machine alone: all of its processes.

    So it does on systems for which it has no clusters; the key is one of Ray's.
    """
    constants = ray._private.ray_constants
    before = os.environ.get(_ALONE), getattr(constants, "ENABLE_RAY_CLUSTER", True)
    if local:
        os.environ[_ALONE], constants.ENABLE_RAY_CLUSTER = "0", False
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER = before[1]
        if before[0] is not None:
            os.environ[_ALONE] = before[0]
        else:
            os.environ.pop(_ALONE, None)


def _close_token_to_others() -> None:
    """Let nobody else read the password that Ray has written for this user."""
    with contextlib.suppress(OSError, RuntimeError):  # there is none, or no home
        named = os.environ.get("RAY_AUTH_TOKEN_PATH")
        (Path(named) if named else Path.home() / ".ray" / "auth_token").chmod(0o600)


def folder_of_workers() -> str:
    """Return the folder that workers of a Ray of this program go back to; "" of any other Ray."""
    return _started_in[0] if _started_in else ""


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
    _started_in.clear()
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
