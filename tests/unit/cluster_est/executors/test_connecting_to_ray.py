"""A Ray that does not start, or a cluster that does not answer, is a sentence.

Ray gives up a start that takes too long, as it does on a busy machine; it is started again then.
"""

import json
import os
import platform
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import ray
from support.problems.springs import ROOT

from cluster_est.errors import ExecutorError
from cluster_est.executors import executor_class, ray_cluster

Failing = Callable[..., list[object]]
TIMED_OUT = Exception("timed out during startup.\nmore")


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Failing:
    """Let Ray fail with errors, one a start; gives the addresses at which it is started."""

    def fail_with(*errors: Exception) -> list[object]:
        starts: list[object] = []

        def start(**options: object) -> None:
            starts.append(options["address"])
            if len(starts) <= len(errors):
                raise errors[len(starts) - 1]

        monkeypatch.setattr(ray, "init", start)
        return starts

    return fail_with


@pytest.mark.parametrize(
    ("address", "error", "said"),
    [
        (None, TIMED_OUT, "Ray did not start on this machine"),
        ("local", RuntimeError("no port"), 'no port.*executor.name to "processes"'),
        ("auto", TimeoutError(), "no Ray cluster was found.*TimeoutError.*join one with"),
        ("ray://h:10001", RuntimeError("no client"), "could not be joined .no client.*reach each"),
    ],
)
def test_why_ray_does_not_start_is_a_sentence(
    failing: Failing,
    monkeypatch: pytest.MonkeyPatch,
    address: str | None,
    error: Exception,
    said: str,
) -> None:
    starts = failing(*[error] * 9)
    monkeypatch.setattr(ray._private.services, "get_ray_address_from_environment", None)
    with pytest.raises(ExecutorError, match=said) as caught:
        executor_class("ray").join(2, address)
    assert "\n" not in str(caught.value)
    assert len(starts) == 1 or address in (None, "local")  # a cluster is asked once


def test_ray_is_started_again_on_a_busy_machine(failing: Failing) -> None:
    starts = failing(TIMED_OUT, TIMED_OUT)
    executor_class("ray").join(2, None)
    assert starts == ["local"] * 3


def refusal(address: str) -> str:
    with pytest.raises(ExecutorError) as caught:
        executor_class("ray").join(2, address)
    said = str(caught.value)
    assert said.startswith("executor.address: ")
    assert address in said
    assert "\n" not in said
    return said


@pytest.mark.parametrize("address", ["somewhere", "10.0.0.1", "10.0.0.1:port", ":6379"])
def test_an_address_that_is_none_is_said_to_be_none(failing: Failing, address: str) -> None:
    starts = failing()
    assert 'must be "auto", "local" or HOST:PORT' in refusal(address)
    assert starts == []


@pytest.fixture
def listening() -> Iterator[str]:
    """The address of somebody who listens and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


def test_a_port_at_which_nobody_listens_is_said_to_be_one(failing: Failing) -> None:
    starts = failing()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    assert "nothing answers at" in refusal(f"127.0.0.1:{port}")
    assert starts == []


def test_a_ray_that_has_ended_is_not_waited_for(
    failing: Failing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its address may still be in the environment, or in the file that "auto" reads."""
    starts = failing()
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    monkeypatch.setenv("RAY_ADDRESS", address)
    assert f'"auto" finds cannot be joined: nothing answers at {address!r}' in refusal("auto")
    assert starts == []


OWN = {"ray_version": ray.__version__, "python_version": platform.python_version()}


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"failed": "AuthenticationError", "why": ""}, "needs its token"),
        ({"failed": "RpcError", "why": ""}, "does not answer like the head of a Ray cluster"),
        (
            {"is": OWN | {"ray_version": "1.0.0"}},
            "has Ray 1.0.0.*install ray==1.0.0 on this machine",
        ),
        ({"is": OWN | {"python_version": "3.1.4"}}, "runs Python 3.1.4.*the same Python"),
        ({"is": OWN}, ""),
        ({"is": OWN, "nodes": {}}, "answers, but none of its nodes is alive"),
        ({"is": OWN, "nodes": {"/no/raylet": "10.0.0.7"}}, "nodes are 10.0.0.7, but is not; run"),
        ({"is": OWN, "nodes": {"/no/raylet": "10.0.0.7", "/": "10.0.0.8"}}, ""),
        ({"is": OWN, "nodes": {"tcp://1.2.3.4:5": "10.0.0.7"}}, ""),
    ],
)
def test_what_keeps_a_cluster_from_being_joined_is_told_apart(
    failing: Failing,
    listening: str,
    monkeypatch: pytest.MonkeyPatch,
    answer: dict[str, object],
    said: str,
) -> None:
    monkeypatch.setattr(ray_cluster, "_ASK", f"print({json.dumps(answer)!r})")
    starts = failing()
    if said:
        with pytest.raises(ExecutorError, match=said):
            executor_class("ray").join(2, listening)
    else:
        executor_class("ray").join(2, listening)
    assert starts == ([] if said else [listening])


@pytest.mark.slow
def test_who_listens_and_is_no_ray_is_said_to_be_none(failing: Failing, listening: str) -> None:
    assert "does not answer like the head of a Ray cluster" in refusal(listening)


ALONE = """
import json, sys
import psutil
from cluster_est.executors import executor_class
if sys.argv[1] == "imported":
    import ray
leave = executor_class("ray").join(2, None)
import ray
ray.get([ray.remote(lambda: 1).remote() for _ in range(2)])
me = psutil.Process()
found = [each for p in (me, *me.children(recursive=True)) for each in p.net_connections()]
print(json.dumps([each.laddr.ip for each in found if each.status == "LISTEN"]))
leave()
"""


@pytest.mark.slow
@pytest.mark.parametrize("before", ["imported", "not imported"])
def test_a_ray_of_ones_own_listens_to_this_machine_alone(tmp_path: Path, before: str) -> None:
    pytest.importorskip("psutil")
    ended = subprocess.run(
        [sys.executable, "-P", "-c", ALONE, before],
        env={**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        check=True,
        text=True,
    )
    addresses = json.loads(ended.stdout.splitlines()[-1])
    assert len(addresses) >= 5
    assert {each.removeprefix("::ffff:") for each in addresses} == {"127.0.0.1"}
    token = tmp_path / ".ray" / "auth_token"
    assert not token.exists() or stat.S_IMODE(token.stat().st_mode) == 0o600
