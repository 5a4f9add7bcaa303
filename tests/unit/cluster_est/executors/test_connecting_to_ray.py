"""A Ray that does not start, or a cluster that does not answer, is a sentence.

Ray gives up a start that takes too long, as it does on a busy machine; it is started again then.
"""

from __future__ import annotations

import pytest
import ray

from cluster_est.errors import ExecutorError
from cluster_est.executors.ray_cluster import connect


@pytest.mark.parametrize(
    ("address", "error", "said"),
    [
        (None, Exception("timed out during startup.\nmore"), r"Ray did not start on this machine"),
        ("local", RuntimeError("no port"), r'\(no port\); .* set executor.name to "processes"'),
        ("10.0.0.1:6379", ConnectionError("refused"), r"answers at '10.0.0.1:6379' \(refused\)"),
        ("auto", TimeoutError(), r"answers at 'auto' \(TimeoutError\); start one, or remove"),
    ],
)
def test_why_ray_does_not_start_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, address: str | None, error: Exception, said: str
) -> None:
    def fail(**_options: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", fail)
    with pytest.raises(ExecutorError, match=said) as caught:
        connect(2, address)
    assert "\n" not in str(caught.value)


def test_ray_is_started_again_on_a_busy_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[object] = []

    def late(**options: object) -> None:
        starts.append(options["address"])
        if len(starts) < 3:
            raise Exception("timed out during startup.")

    monkeypatch.setattr(ray, "init", late)
    assert connect(2, None)
    assert starts == ["local"] * 3


def test_a_cluster_that_does_not_answer_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[object] = []

    def refuse(**options: object) -> None:
        starts.append(options["address"])
        raise ConnectionError("refused")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ExecutorError, match="refused"):
        connect(2, "10.0.0.1:6379")
    assert starts == ["10.0.0.1:6379"]
