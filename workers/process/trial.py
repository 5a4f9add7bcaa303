"""Test benches for an FMU: each probe runs in a separate process, with a time limit."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Self, final

from typing_extensions import override

from workers.errors import ModelError
from workers.evaluate import Evaluator, FmuProbe
from workers.fmu.process_environment import set_environment_here
from workers.messages import Experiment, Model
from workers.process.forked import CAN_FORK, ForkClient


@dataclass(frozen=True)
class NoAnswer:
    """The reason why there is no answer.

    Attributes
    ----------
    message
        Part of a sentence that describes what happened.
    late
        Whether the time limit was exceeded.
    loading
        Whether it happened while the FMU was loaded.
    crashed
        Whether the process has ended.
    """

    message: str
    late: bool = False
    loading: bool = False
    crashed: bool = False


class ProbeBench(ABC):
    """Runs probes of an FMU: in separate processes, or in this process on systems without fork."""

    @staticmethod
    def open(model: Model, experiments: Sequence[Experiment]) -> ProbeBench:
        """Open the bench that this system supports.

        Parameters
        ----------
        model, experiments
            Model and experiments of the probes.
        """
        return (ForkedBench if CAN_FORK else BenchHere)(model, tuple(experiments))

    @abstractmethod
    def ask(self, probe: FmuProbe | None, seconds: float) -> Any:
        """Load the FMU anew and run a probe; return `NoAnswer` if there is no answer.

        Parameters
        ----------
        probe
            The probe; None to load the FMU only.
        seconds
            Time limit, if this bench can apply one.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@final
class ForkedBench(ProbeBench):
    """Runs each probe in a separate process, so a crash affects only that process."""

    def __init__(self, model: Model, experiments: tuple[Experiment, ...]) -> None:
        self._forks = ForkClient((model, experiments, "check"))

    @override
    def ask(self, probe: FmuProbe | None, seconds: float) -> Any:
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

    @override
    def close(self) -> None:
        self._forks.close()


@final
class BenchHere(ProbeBench):
    """Runs probes in this process, for systems without `fork`.

    A crash of the FMU ends this process, and time limits do not apply.
    """

    def __init__(self, model: Model, experiments: tuple[Experiment, ...]) -> None:
        self._model, self._experiments = model, experiments

    @override
    def ask(self, probe: FmuProbe | None, seconds: float) -> Any:
        try:
            set_environment_here(self._model)
            evaluator = Evaluator(self._model, self._experiments, "check")
            with contextlib.closing(evaluator):
                evaluator.load()
                if probe is None:
                    return None
                return _answered(probe, evaluator)
        except ModelError as error:
            return NoAnswer(str(error), loading=True)

    @override
    def close(self) -> None:
        """Do nothing, because every probe has already released its resources."""


def _answered(probe: FmuProbe, evaluator: Evaluator) -> Any:
    try:
        return probe.answer(evaluator)
    except ModelError as error:
        return NoAnswer(str(error))


def _receive(connection: Connection, end: float, seconds: float, *, loading: bool) -> Any:
    if connection.poll(max(end - time.monotonic(), 0.0)):
        return connection.recv()
    return NoAnswer(f"there was no answer within {seconds:.2g} s", late=True, loading=loading)


def _how(code: int | None) -> str:
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return f"its process crashed ({signal.Signals(-code).name})"
    return f"its process was ended (exit code {code})"
