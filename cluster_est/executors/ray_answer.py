"""Why a Ray cluster cannot be joined, found out before Ray tries it, which takes minutes."""

from __future__ import annotations

import json
import os
import platform
import socket
import subprocess
import sys
from importlib.metadata import version

SECONDS_TO_CONNECT, SECONDS_TO_ANSWER = 2.0, 7.0
_ASK = """
import json, sys
from ray._raylet import GcsClient
try:
    client = GcsClient(address=sys.argv[1])
    said = {"is": json.loads(client.internal_kv_get(b"CLUSTER_METADATA", b"cluster", timeout=5))}
except Exception as error:
    said = {"failed": type(error).__name__, "why": str(error)}
print(json.dumps(said))
"""
"""Prints what the head says of itself. Ray may end a process that gets no answer."""


def why_not_joined(address: str) -> str:
    """Return why a cluster cannot be joined at HOST:PORT; "" if nothing is known against it."""
    host, _, port = address.rpartition(":")
    if not host or "//" in address or not port.isdigit():
        return ""  # "auto" and what else Ray knows
    try:
        socket.create_connection((host.strip("[]"), int(port)), SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError) as error:
        return (
            f"nothing answers at {address!r} ({error}); check host and port, which are those of "
            '"ray start --head --port", and that this machine may reach them'
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
    """Return what is wrong with what the head says of itself, or with the question."""
    cluster = said.get("is")
    if isinstance(cluster, dict):
        return _other_version(address, cluster)
    if said["failed"] == "AuthenticationError":
        return (
            f"the Ray cluster at {address!r} must be given its token, which is missing here or "
            "another one; set RAY_AUTH_MODE=token, and put it into ~/.ray/auth_token or a file "
            'that RAY_AUTH_TOKEN_PATH names (a node of the cluster prints it with "ray '
            'get-auth-token")'
        )
    return (
        f"what listens at {address!r} does not answer as the head of a Ray cluster; check the "
        'port, which is that of "ray start --head --port", 6379 unless it says another one'
    )


def _other_version(address: str, cluster: dict[str, str]) -> str:
    """Return how the versions there differ from those here; "" if they go together."""
    here, python = version("ray"), platform.python_version()
    there = cluster.get("ray_version", here), cluster.get("python_version", python)
    if there[0] != here:
        return (
            f"the Ray cluster at {address!r} has Ray {there[0]}, which must be the same here, where"
            f" it is {here}; install ray=={there[0]} here, or {here} there"
        )
    if there[1].split(".")[:2] != python.split(".")[:2]:
        return (
            f"the Ray cluster at {address!r} runs Python {there[1]}, whose first two numbers must "
            f"be the same here, where it is {python}; use the same Python on both sides"
        )
    return ""
