"""Connection to a Ray cluster, or start of Ray on this machine alone.

The connection is checked before Ray tries to join, because a failed attempt of Ray takes minutes.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import ray
from ray.exceptions import RayTaskError

from cluster_est.errors import ExecutorError, ModelError

SECONDS_TO_CONNECT, SECONDS_TO_ANSWER = 2.0, 7.0
_ASK = """
import json, sys
from ray._raylet import GcsClient
try:
    client = GcsClient(address=sys.argv[1])
    said = {"is": json.loads(client.internal_kv_get(b"CLUSTER_METADATA", b"cluster", timeout=5))}
    nodes = client.get_all_node_info(timeout=5).values()
    said["nodes"] = {n.raylet_socket_name: n.node_manager_address for n in nodes if not n.state}
except Exception as error:
    said = {"failed": type(error).__name__, "why": str(error)}
print(json.dumps(said))
"""
"""Script that prints the head's data of the cluster and of the live nodes (state 0).

It runs in a separate process, because Ray may end a process without an answer."""


def why_not_joined(address: str) -> str:
    """Return the reason why a cluster at HOST:PORT cannot be joined; "" if none is known."""
    if address == "auto" or "//" in address:
        return ""  # Ray resolves such addresses
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        return (
            f'must be "auto", "local" or HOST:PORT, as in "10.0.0.1:6379", but is {address!r}; use '
            'the port of "ray start --head --port"'
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError) as error:
        return (
            f'nothing answers at {address!r} ({error}); compare host and port with those of "ray '
            'start --head --port", and check that this machine can reach them'
        )
    try:
        asked = subprocess.run(
            [sys.executable, "-P", "-c", _ASK, address],
            env={**os.environ, "RAY_BACKEND_LOG_LEVEL": "fatal"},
            capture_output=True,
            timeout=SECONDS_TO_ANSWER,
            check=False,
        )
        said = json.loads(asked.stdout.splitlines()[-1])
    except (subprocess.TimeoutExpired, ValueError, IndexError):
        said = {"failed": "", "why": ""}
    except OSError:
        return ""
    return _judged(address, said)


def _judged(address: str, said: dict[str, dict[str, str] | str]) -> str:
    """Return the reason against joining, from the head's answer; "" if there is none."""
    cluster, nodes = said.get("is"), said.get("nodes")
    if isinstance(cluster, dict):
        found = _other_version(address, cluster)
        return found or (_no_node_here(address, nodes) if isinstance(nodes, dict) else "")
    if said["failed"] == "AuthenticationError":
        return (
            f"the Ray cluster at {address!r} needs its token, which is missing or wrong on this "
            "machine; set RAY_AUTH_MODE=token, and write the token to ~/.ray/auth_token or to a "
            'file that RAY_AUTH_TOKEN_PATH names (on a node of the cluster, "ray get-auth-token" '
            "prints it)"
        )
    return (
        f"the program at {address!r} does not answer like the head of a Ray cluster; check the "
        'port, which "ray start --head --port" sets (default 6379)'
    )


def _other_version(address: str, cluster: dict[str, str]) -> str:
    """Return a message if the cluster's versions are incompatible with this machine's, else ""."""
    here, python = version("ray"), platform.python_version()
    there = cluster.get("ray_version", here), cluster.get("python_version", python)
    if there[0] != here:
        return (
            f"the Ray cluster at {address!r} has Ray {there[0]}, but this machine has Ray {here}; "
            f"install ray=={there[0]} on this machine, or ray=={here} on the cluster"
        )
    if there[1].split(".")[:2] != python.split(".")[:2]:
        return (
            f"the Ray cluster at {address!r} runs Python {there[1]}, but this machine runs Python "
            f"{python}, and the first two numbers must agree; use the same Python on both"
        )
    return ""


def _no_node_here(address: str, nodes: dict[str, str]) -> str:
    """Return a message if no node of a cluster is on this machine; "" if there is one or unknown.

    A node has a socket in the file system of its machine. Without a node Ray would try for a
    minute.
    """
    if any(not name.startswith("/") or Path(name).exists() for name in nodes):
        return ""
    if not nodes:
        return (
            f"the head of the Ray cluster at {address!r} answers, but none of its nodes is alive; "
            'stop it there with "ray stop", and start it again'
        )
    others = ", ".join([*dict.fromkeys(nodes.values())][:MOST_NAMED_NODES])
    return (
        f"this machine must be a node of the Ray cluster at {address!r}, whose nodes are {others}, "
        f'but is not; run "ray start --address={address}" on this machine first (with --num-cpus=0 '
        "if it must not simulate), or submit the fit to the cluster with ray job submit"
    )


_PACKAGES = Path(__file__).parents[2]
"""Folder of this package and `workers`, from which Ray's workers import in any case."""
_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_started_in: list[str] = []
"""Working folder of this program when it started Ray; empty if it did not start Ray."""

MOST_NAMED_NODES = 4

LOCAL_STARTS = 3
"""Attempts to start Ray on this machine; 15 seconds per attempt may be too few on a busy one."""


def connect(workers: int | None, address: str | None) -> bool:
    """Join the cluster at an address, or start Ray here with as many cores as workers.

    Returns
    -------
    bool
        False if this process was connected already; then the caller must not disconnect.

    Raises
    ------
    ExecutorError
        If no cluster answers at the address, or Ray does not start on this machine.
    """
    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    local = address in (None, "", "local")
    if not local and (reason := why_not_joined(_meant_by(str(address)))):
        found = 'the Ray that "auto" finds cannot be joined: ' if address == "auto" else ""
        raise ExecutorError(f"executor.address: {found}{reason}")
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
        except Exception as error:  # Ray has no specific class for a start that takes too long
            disconnect()
            if not left:
                line = (str(error).splitlines() or [type(error).__name__])[0]
                raise ExecutorError(_not_connected(address, line, local=local)) from error
    return True


def _meant_by(address: str) -> str:
    """Return the address that Ray uses for "auto"; it may belong to a Ray that has ended."""
    if address != "auto":
        return address
    with contextlib.suppress(Exception):  # Ray reports a missing cluster itself
        found = ray._private.services.get_ray_address_from_environment(address, None)
        return address if found is None else str(found)
    return address


@contextlib.contextmanager
def _away_from_the_users_files() -> Iterator[str]:
    """Work in a folder without files of the user, and return; yield the folder before.

    Ray's workers import first from the folder in which Ray is started or joined. A numpy.py in the
    user's folder would be executed.
    """
    try:
        before = os.getcwd()
    except OSError:  # the folder has been removed
        before = ""
    os.chdir(_PACKAGES)
    try:
        yield before
    finally:
        if before:
            os.chdir(before)


@contextlib.contextmanager
def _alone(local: bool) -> Iterator[None]:
    """Make all processes of a Ray that is started here listen to this machine alone.

    Ray does this on systems without support for clusters; this sets Ray's key for it.
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
    """Restrict the token file that Ray has written for this user to this user."""
    with contextlib.suppress(OSError, RuntimeError):  # no such file, or no home
        named = os.environ.get("RAY_AUTH_TOKEN_PATH")
        (Path(named) if named else Path.home() / ".ray" / "auth_token").chmod(0o600)


def folder_of_workers() -> str:
    """Return the working folder for workers of a Ray that this program started; else ""."""
    return _started_in[0] if _started_in else ""


def _not_connected(address: str | None, line: str, *, local: bool) -> str:
    if local:
        return (
            f"executor: Ray did not start on this machine ({line}); try again when it is less "
            'busy, or set executor.name to "processes"'
        )
    if address == "auto":
        return (
            f"executor.address: no Ray cluster was found on this machine ({line}); join one with "
            '"ray start --address=HOST:PORT", or remove the key to use only this machine'
        )
    return (
        f"executor.address: the Ray cluster at {address!r} could not be joined ({line}), for an "
        "unknown reason; check that its nodes and this machine can reach each other at all of "
        "Ray's ports, or remove the key to use only this machine"
    )


def disconnect() -> None:
    """Leave the cluster; stop Ray if `connect` started it."""
    _started_in.clear()
    ray.shutdown()


def cores() -> int:
    """Return the number of cores that the cluster has at the moment, at least one."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def why_not_started(error: Exception) -> Exception:
    """Return the model's error if it raised one, or an ExecutorError with Ray's message."""
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
