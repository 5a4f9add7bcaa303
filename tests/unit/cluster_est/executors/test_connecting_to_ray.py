"""A Ray that does not start, or a cluster that does not answer, is a sentence."""

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
