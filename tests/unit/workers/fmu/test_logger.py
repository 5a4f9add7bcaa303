"""Messages of FMUs find the instance that they are of."""

import weakref
from collections import deque

import pytest

from workers.fmu import logger


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> deque[str]:
    """The log of the only instance of a process."""
    monkeypatch.setattr(logger, "_logs", weakref.WeakValueDictionary())
    log: deque[str] = deque()
    logger.open_log("model-1", log, shown=False)
    return log


@pytest.mark.parametrize("name", ["model-1", " model-1 ", "", "another name"])
def test_the_only_instance_gets_what_names_no_other(alone: deque[str], name: str) -> None:
    say = logger.log_message_3(name)
    say(None, 3, b"", b" it could not go on ")
    say(None, 0, b"", b"all is well")
    assert list(alone) == ["it could not go on"]


def test_with_several_instances_only_a_name_tells(alone: deque[str]) -> None:
    other: deque[str] = deque()
    logger.open_log("model-2", other, shown=False)
    logger.log_message_3("model-2")(None, 3, b"", b"it could not go on")
    logger.log_message_3("nobody")(None, 3, b"", b"whose is this")
    assert not alone
    assert list(other) == ["it could not go on"]
