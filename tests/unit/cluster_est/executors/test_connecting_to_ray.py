"""A Ray that does not start, or a cluster that does not answer, is a sentence.

Ray gives up a start that takes too long, as it does on a busy machine; it is started again then.
"""

from collections.abc import Callable

import pytest
import ray

from cluster_est.errors import ExecutorError
from cluster_est.executors import executor_class

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
        ("10.0.0.1:6379", ConnectionError("refused"), "answers at '10.0.0.1:6379'.*refused"),
        ("auto", TimeoutError(), "answers at 'auto'.*TimeoutError.*start one, or remove"),
    ],
)
def test_why_ray_does_not_start_is_a_sentence(
    failing: Failing, address: str | None, error: Exception, said: str
) -> None:
    starts = failing(*[error] * 9)
    with pytest.raises(ExecutorError, match=said) as caught:
        executor_class("ray").join(2, address)
    assert "\n" not in str(caught.value)
    assert len(starts) == 1 or address in (None, "local")  # a cluster is asked once


def test_ray_is_started_again_on_a_busy_machine(failing: Failing) -> None:
    starts = failing(TIMED_OUT, TIMED_OUT)
    executor_class("ray").join(2, None)
    assert starts == ["local"] * 3
