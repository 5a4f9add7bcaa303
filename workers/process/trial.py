"""A place where an FMU is tried out: each question goes to a process of its own, with a limit."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self

from workers.errors import ModelError
from workers.messages import Experiment, Model
from workers.probes.base import FmuProbe
from workers.process.forked import ForkClient


@dataclass(frozen=True)
class NoAnswer:
    """Why there is no answer.

    Attributes
    ----------
    message
        Part of a sentence: what happened.
    late
        Whether it only took too long.
    loading
        Whether that was before the FMU was there to be asked.
    crashed
        Whether the process has ended.
    """

    message: str
    late: bool = False
    loading: bool = False
    crashed: bool = False


class ProbeBench:
    """Asks probes about an FMU. Whatever it does, only the process that is asked suffers.

    Parameters
    ----------
    model, experiments
        What is tried out.
    """

    def __init__(self, model: Model, experiments: Sequence[Experiment]) -> None:
        self._forks = ForkClient((model, tuple(experiments), "check"))

    def ask(self, probe: FmuProbe | None, seconds: float) -> Any:
        """Load the FMU in a new process and ask it; `NoAnswer` if there is no answer.

        Parameters
        ----------
        probe
            What is asked; None to load the FMU only.
        seconds
            When the process is ended.
        """
        process, connection = self._forks.fork()
        end = time.monotonic() + seconds
        try:
            said = _receive(connection, end, seconds, loading=True)
            if isinstance(said, ModelError):
                return NoAnswer(str(said), loading=True)
            if isinstance(said, NoAnswer) or probe is None:
                return said
            connection.send(probe)
            answer = _receive(connection, end, seconds, loading=False)
            return NoAnswer(str(answer)) if isinstance(answer, ModelError) else answer
        except (EOFError, OSError):
            code = self._forks.wait(process)
            return NoAnswer(_how(code), loading=probe is None, crashed=True)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            connection.close()

    def close(self) -> None:
        self._forks.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _receive(connection: Connection, end: float, seconds: float, *, loading: bool) -> Any:
    if connection.poll(max(end - time.monotonic(), 0.0)):
        return connection.recv()
    return NoAnswer(f"it did not end within {seconds:.2g} s", late=True, loading=loading)


def _how(code: int | None) -> str:
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return f"its process crashed ({signal.Signals(-code).name})"
    return f"its process was ended (exit code {code})"
