"""The program `cluster-est`: from arguments to a command, and from exceptions to messages.

Before a command is imported, pyarrow makes its first array while pandas is hidden. Otherwise it
would import pandas, in order to recognise columns of pandas, which takes a quarter of a second. No
command passes such columns. Later conversions of pyarrow to pandas still work.

Errors on standard output and error end no command. If a pipe is closed or a disk is full, the
output is dropped and the command continues, because its results are in files.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

import numpy as np
from typing_extensions import override

from cluster_est.cli.answer import Answer, DocumentAnswer, PrintedAnswer
from cluster_est.cli.criterion import Criterion
from cluster_est.cli.document import as_text, document_of
from cluster_est.cli.parent_process import (
    ExitCode,
    address_space,
    end,
    interrupts_can_be_raised,
    tell_of_fmu,
)
from cluster_est.cli.parser import UsageError, parse
from cluster_est.config.config_text import with_lines
from cluster_est.errors import ClusterEstError
from cluster_est.running.interrupts import terminations
from workers import caches
from workers.fmu.process_environment import before_first_instance


class _WithoutPandas(MetaPathFinder):
    """Hides pandas from imports."""

    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError(fullname)


def start_arrow() -> None:
    """Make pyarrow's first array while pandas is hidden."""
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    finder = _WithoutPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)


COMMANDS = {
    "init": "init_command",
    "check": "check_command",
    "fit": "run_commands",
    "close-loop": "run_commands",
    "sensitivity": "run_commands",
    "design": "design_command",
    "simulate": "run_commands",
    "show": "folder_commands",
    "report": "folder_commands",
    "watch": "watch_command",
    "export": "folder_commands",
    "sweep": "run_commands",
    "replay": "replay_command",
    "forms": "forms_command",
}
"""The module of `cluster_est.cli` that contains each command as a function of its name."""


def run_command(options: Namespace, answer: Answer) -> int:
    """Run the requested command, and return its exit code.

    Its module is imported now, so that a simple command does not import the modules of a fit.
    """
    start_arrow()
    name: str = options.command
    module = import_module(f"cluster_est.cli.{COMMANDS[name]}")
    return int(getattr(module, name.replace("-", "_"))(options, answer))


LONGEST_LINE = 2000


def readable(text: str) -> str:
    """Return a message that is safe for a terminal, whatever it quotes from a file.

    Unprintable characters are escaped, because a terminal may interpret them. Very long lines are
    shortened in the middle.
    """
    return "\n".join(_cut("".join(map(_printable, line))) for line in text.split("\n"))


def _printable(letter: str) -> str:
    return letter if letter.isprintable() else repr(letter)[1:-1]


def _cut(line: str) -> str:
    return line if len(line) <= LONGEST_LINE else f"{line[:1000]} ... {line[-500:]}"


class _Outlet(io.FileIO):
    """A descriptor that accepts all data; `refused` is the first write error."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.refused: OSError | None = None

    @override
    def write(self, data: Any, /) -> int:
        if self.refused is None:
            try:
                return super().write(data)
            except OSError as error:
                self.refused = error
        return len(data)


class LenientStreams:
    """Replaces both output streams of this process, if they exist.

    With a document, only `document_to` writes to standard output. All other output, such as that of
    an FMU in this process or of Ray, goes to standard error.
    """

    def __init__(self, *, with_document: bool = False) -> None:
        self._outlets: list[_Outlet] = []
        self.document_to: TextIO | None = None
        if with_document:
            with contextlib.suppress(AttributeError, OSError, ValueError):  # not a system file
                kept = os.dup(sys.stdout.fileno())
                self.document_to = self._leading_to(kept, "ascii", "strict")
                os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        sys.stdout, sys.stderr = self._around(sys.stdout), self._around(sys.stderr)

    def _around(self, stream: TextIO) -> TextIO:
        try:
            stream.flush()
            return self._leading_to(stream.fileno(), stream.encoding, stream.errors)
        except (AttributeError, OSError, ValueError):  # none, or not a file of the system
            return stream

    def _leading_to(self, descriptor: int, encoding: str, errors: str | None) -> TextIO:
        outlet = _Outlet(descriptor)
        self._outlets.append(outlet)
        return io.TextIOWrapper(
            io.BufferedWriter(outlet), encoding=encoding, errors=errors, line_buffering=True
        )

    def lost(self) -> str:
        """Return why output was lost, as part of a sentence; "" if the reader has gone."""
        for stream in filter(None, (sys.stdout, sys.stderr, self.document_to)):
            stream.flush()
        refused = [each.refused for each in self._outlets if each.refused is not None]
        reasons = [error.strerror or str(error) for error in refused if error.errno != errno.EPIPE]
        return reasons[0] if reasons else ""


STANDARD_OUTPUT_LOST = (
    "standard output: cannot be written ({}); redirect it and repeat the command; cluster-est show "
    "prints the results of a run"
)


def main(arguments: Sequence[str] | None = None, document_to: TextIO | None = None) -> int:
    """Run a command and return its exit code; its document goes to standard output by default."""
    given = sys.argv[1:] if arguments is None else [*arguments]
    try:
        options = parse(given)
    except UsageError as error:
        sys.stderr.write(f"{error.usage}{error.prog}: error: {error}\n")
        if "--json" in given:
            refused = DocumentAnswer()
            refused.add(message=str(error))
            command = next((each for each in error.prog.split()[1:]), None)
            _write(document_of(command, refused, ExitCode.BAD_INPUT), document_to)
        raise SystemExit(int(ExitCode.BAD_INPUT)) from None
    interrupts_can_be_raised()
    answer = DocumentAnswer() if options.json else PrintedAnswer()
    code = ExitCode.NO_SOLUTION
    try:
        criteria = [Criterion(each, options.command) for each in options.fail_if]
        # code that needs finite numbers reports it itself
        with terminations(), np.errstate(all="ignore"):
            code = ExitCode(run_command(options, answer))
        code = _judge(options.command, answer, code, criteria)
    except ClusterEstError as error:
        answer.fail(readable(_placed(str(error), options)))
        code = ExitCode.BAD_INPUT
    except OSError as error:
        answer.fail(readable(_refused(error)))
        code = ExitCode.BAD_INPUT
    except KeyboardInterrupt:
        answer.fail("interrupted")
        code = ExitCode.INTERRUPTED
    except Exception as error:
        if not isinstance(error, MemoryError) and address_space() == np.inf:
            answer.add(message=f"{type(error).__name__}: {error}")
            raise
        answer.fail(_short_of_memory(error))
    finally:
        if said := caches.notice():
            answer.complain(said)
        if options.json:
            _write(document_of(options.command, answer, code), document_to)
    return code


def _judge(command: str, answer: Answer, code: ExitCode, criteria: Sequence[Criterion]) -> ExitCode:
    """Return the exit code with regard to --fail-if; a failed command keeps its own code."""
    if not criteria:
        return code
    document = document_of(command, answer, code)
    judged = [each.judge(document) for each in criteria]
    answer.add(criteria=[vars(each) for each in judged])
    for each in judged:
        if each.met:
            answer.complain(each.sentence)
    met = any(each.met for each in judged)
    return ExitCode.CRITERION_MET if met and code == ExitCode.DONE else code


def _write(document: Mapping[str, Any], to: TextIO | None) -> None:
    stream = sys.stdout if to is None else to
    stream.write(f"{as_text(document)}\n")
    stream.flush()


def _refused(error: OSError) -> str:
    """Return an error of the system as a message, with the file if there is one."""
    where = f"{error.filename}: " if error.filename is not None else ""
    return (
        f"{where}the operating system reports: {error.strerror or error}; correct that and repeat "
        "the command, with --resume if a run had begun"
    )


def _short_of_memory(error: Exception) -> str:
    """Return a message on missing memory, without which libraries fail in many ways."""
    said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    limit = address_space()
    if limit < np.inf:
        return (
            f"the command failed ({said}) with {limit:.3g} GB of address space, which is too "
            "little for many libraries; raise the limit (ulimit -v), and continue with --resume if "
            "a run had begun"
        )
    return (
        f"there was not enough memory ({said}); provide more memory, or use fewer samples, workers "
        "or starts, and continue with --resume if a run had begun"
    )


def _placed(message: str, options: Namespace) -> str:
    """Return a message with line numbers of the config."""
    config = getattr(options, "config", None)
    if config is None:
        return message
    overridden = [each.partition("=")[0] for each in getattr(options, "overrides", ())]
    return with_lines(message, Path(config), overridden)


def run() -> None:
    """Run a command as a program, and end with its exit code even if threads are still running."""
    before_first_instance(tell_of_fmu)
    streams = LenientStreams(with_document="--json" in sys.argv[1:])
    try:
        code = main(document_to=streams.document_to)
        lost = streams.lost()
        if lost:
            print(f"cluster-est: {STANDARD_OUTPUT_LOST.format(lost)}", file=sys.stderr)
            code = code or ExitCode.BAD_INPUT
    except SystemExit as ended:  # raised by the parser: help, or a usage error
        code = ended.code if isinstance(ended.code, int) else ExitCode.DONE
    except Exception:
        sys.excepthook(*sys.exc_info())
        code = ExitCode.NO_SOLUTION
    # a running simulation must not keep the process alive
    end(code, in_order=code != ExitCode.INTERRUPTED)
