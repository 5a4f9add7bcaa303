"""Hands nearly valid configs, tables and FMUs to the commands: what may no user ever see?

Every input must end within seconds with exit code 0, 1 or 2, and for code 2 with a sentence on each
line. There must be no exception, no warning, no crash, and no written file. Inputs come from
Hypothesis and run in separate processes, so that a crash or a hang is counted and does not stop the
next inputs.

    python scripts/fuzz.py --inputs 10000 --seed 0

prints the outcomes of the inputs by kind, the slowest input, and each fault once. The input of a
fault is stored in the folder of --keep. The exit code is 1 if there is a fault.
"""

from __future__ import annotations

import argparse
import collections
import os
import shutil
import sys
import tempfile
import traceback
from dataclasses import dataclass, field
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from fuzzing.base import Input, Verdict, judge, write
from fuzzing.inputs import INPUTS
from hypothesis import HealthCheck, Phase, given, seed, settings

CHUNK = 250
"""Number of inputs of one process."""
LONGEST_SECONDS = 30.0
"""Seconds after which an input counts as hanging."""


@dataclass
class Tally:
    """Outcomes of all inputs so far."""

    codes: collections.Counter[tuple[str, str]] = field(default_factory=collections.Counter)
    faults: dict[str, list[Path]] = field(default_factory=lambda: collections.defaultdict(list))
    slowest: list[tuple[float, str]] = field(default_factory=list)

    def add(self, kind: str, verdict: Verdict, kept: Path) -> None:
        code = "fault" if verdict.fault else str(verdict.code)
        self.codes[kind, code] += 1
        self.slowest = sorted([(verdict.seconds, kind), *self.slowest], reverse=True)[:5]
        if verdict.fault:
            self.faults[_last_lines(verdict.fault)].append(kept)

    def report(self) -> str:
        kinds = sorted({kind for kind, _ in self.codes})
        ends = sorted({code for _, code in self.codes})
        lines = [f"{'kind':<14}" + "".join(f"{end:>9}" for end in ends)]
        lines += [f"{k:<14}" + "".join(f"{self.codes[k, e]:>9}" for e in ends) for k in kinds]
        slow = ", ".join(f"{seconds:.1f} s ({kind})" for seconds, kind in self.slowest)
        lines += [f"{sum(self.codes.values())} inputs; slowest: {slow}"]
        for fault, kept in self.faults.items():
            lines += ["", f"{len(kept)} times, as in {kept[0]}:", fault]
        return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--inputs", type=int, default=10000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--keep", type=Path, help="folder for inputs with faults; default: a new one"
    )
    options = parser.parse_args()
    keep = options.keep or Path(tempfile.mkdtemp(prefix="fuzz-"))
    keep.mkdir(parents=True, exist_ok=True)
    tally = Tally()
    done = 0
    while done < options.inputs:
        count = min(CHUNK, options.inputs - done)
        done += _chunk(tally, count, options.seed * 1_000_003 + done, keep)
        print(f"{done} inputs, {sum(map(len, tally.faults.values()))} faults", flush=True)
    print(tally.report())
    return 1 if tally.faults else 0


def _chunk(tally: Tally, count: int, number: int, keep: Path) -> int:
    """Run inputs in a process until all are done or it dies; return their number."""
    mine, theirs = Pipe()
    home = Path(tempfile.mkdtemp(prefix="fuzz-run-"))
    process = get_context("fork").Process(target=_serve, args=(theirs, count, number, home))
    process.start()
    theirs.close()
    done = 0
    input_now: Input | None = None
    try:
        while mine.poll(LONGEST_SECONDS):
            said = mine.recv()
            if isinstance(said, str):
                raise SystemExit(said)
            if isinstance(said, Verdict) and input_now is not None:
                tally.add(input_now.kind, said, _keep(input_now, said, keep))
                done, input_now = done + 1, None
            else:
                input_now = said
        process.kill()
        fault = f"did not end within {LONGEST_SECONDS:g} s"
    except EOFError:
        process.join()
        fault = f"the process ended with exit code {process.exitcode}"
    process.join()
    shutil.rmtree(home, ignore_errors=True)
    if input_now is not None:
        verdict = Verdict(None, LONGEST_SECONDS, "", fault)
        tally.add(input_now.kind, verdict, _keep(input_now, verdict, keep))
        done += 1
    elif done == 0:
        raise SystemExit(f"no inputs could be made: {fault}")
    return done


def _serve(connection: Connection, count: int, number: int, home: Path) -> None:
    """Make inputs and run them; each is reported before it starts."""
    os.environ["CLUSTER_EST_CACHE"] = str(home / "cache")
    with (home / "native").open("ab") as native:  # for output of libraries that bypasses Python
        os.dup2(native.fileno(), 1)
        os.dup2(native.fileno(), 2)

    @seed(number)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(INPUTS)
    def run(given_input: Input) -> None:
        connection.send(given_input)
        with tempfile.TemporaryDirectory(dir=home) as folder:
            write(given_input, Path(folder))
            verdict = judge(given_input, Path(folder))
        said = (home / "native").stat().st_size
        if said and not verdict.fault:
            text = (home / "native").read_text(encoding="utf-8", errors="replace")
            verdict = Verdict(verdict.code, verdict.seconds, "", f"a library said: {text}")
            os.truncate(home / "native", 0)
        connection.send(verdict)

    try:
        run()
    except Exception:  # an error of Hypothesis, which the parent reports
        connection.send(traceback.format_exc())


def _keep(given_input: Input, verdict: Verdict, keep: Path) -> Path:
    """Write an input with a fault to its own folder."""
    if not verdict.fault:
        return keep
    folder = keep / f"{len(list(keep.iterdir())):04d}"
    folder.mkdir()
    write(given_input, folder)
    command = f"{' '.join(given_input.arguments)}\n{verdict.fault}\n{verdict.said}"
    (folder / "fault.txt").write_text(command, encoding="utf-8", errors="replace")
    return folder


def _last_lines(fault: str) -> str:
    """Return the origin and the message of an exception, which distinguish faults."""
    return "\n".join(line[:300] for line in fault.strip().split("\n")[-3:])


if __name__ == "__main__":
    sys.exit(main())
