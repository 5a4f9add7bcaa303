"""Measure how long a user waits before something is on the screen.

    python scripts/bench_start.py [--rounds 5]

CPU seconds (user and system, of the command and its children), wall seconds and those until
anything is printed, each the median of the rounds: of the help, of `show`, of `init`, of the import
from Python, and of a fit and `check` of the embedded example, warm, with the compiled loops in a
cache, and cold, with an empty one. At the end the sizes of the report and of the README. All is
done on copies in a temporary folder.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = (sys.executable, "-m", "cluster_est")


@dataclass(frozen=True)
class Seconds:
    """CPU and wall seconds of a command, and until its first output."""

    processor: float
    wall: float
    first: float


def main() -> None:
    """Measure everything and print a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(ROOT / "configs", folder / "configs")
        config = str(folder / "configs" / "mass_spring_damper.toml")
        run = folder / "run"
        fit = [*PROGRAM, "fit", config, "--out", str(run), "--overwrite"]
        measured(fit, folder)  # fills the cache
        table = next((folder / "configs").rglob("*.csv"))
        model = str(folder / "configs" / "models" / "mass_spring_damper.fmu")
        init = [
            *PROGRAM,
            "init",
            model,
            str(table),
            "--out",
            str(folder / "new.toml"),
            "--overwrite",
        ]
        warm = {
            "help": [*PROGRAM, "--help"],
            "show": [*PROGRAM, "show", str(run)],
            "init": init,
            "import": [sys.executable, "-c", "import cluster_est"],
            "fit, warm": fit,
        }
        for what, command in warm.items():
            say(what, [measured(command, folder) for _ in range(rounds)])
        cold = {"fit, cold": fit, "check, cold": [*PROGRAM, "check", config]}
        for what, command in cold.items():
            say(what, [measured(command, folder, cold=True) for _ in range(rounds)])
        size = (run / "report.html").stat().st_size / 1e6
        lines = len((ROOT / "README.md").read_text(encoding="utf-8").splitlines())
        print(f"report {size:.2f} MB; README {lines} lines")


def measured(command: Sequence[str], folder: Path, *, cold: bool = False) -> Seconds:
    """Run a command; with `cold`, with an empty cache of what has been compiled."""
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    if cold:
        environment["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(dir=folder)
    before, begin, first = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), 0.0
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        assert process.stdout is not None
        said = process.stdout.read(1)
        first = time.monotonic() - begin
        said += process.stdout.read()
    wall = time.monotonic() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(command)}: {said.decode(errors='replace')}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Seconds(used, wall, first if said else wall)


def say(what: str, found: Sequence[Seconds]) -> None:
    """Print the medians of a command."""
    median = [
        statistics.median(getattr(each, key) for each in found)
        for key in ("processor", "wall", "first")
    ]
    print(
        f"{what:14} {median[0]:7.2f} CPU s {median[1]:7.2f} s   output after {median[2]:.2f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
