"""Run the same fit and the same closed loop on an idle and on a busy machine, and compare all bits.

    python scripts/busy_machine.py [--busy 6] [--times 3] [--workers 2] [--config PATH]

Each runs on Ray workers, with `differences = "auto"`, first with nothing beside it and then with
busy processes. Printed are seconds, evaluations, simulations and failures of each run, and every
table, column or fact that differs from the first one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from record_results import COMMAND, compare_all

CONFIG = Path("configs/mass_spring_damper.toml")
COUNTS = ("seconds", "evaluations", "simulations", "failures")


def main() -> int:
    """Run and compare; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--busy", type=int, default=6, help="busy processes")
    parser.add_argument("--times", type=int, default=3, help="runs of each kind")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--config", type=Path, default=CONFIG)
    options = parser.parse_args()
    different = 0
    with tempfile.TemporaryDirectory() as folder:
        for command in ("fit", "close-loop"):
            runs = [Path(folder) / command / f"{i}" for i in range(2 * options.times)]
            for i, out in enumerate(runs):
                with busy(options.busy if i >= options.times else 0) as how:
                    run(command, options.config, out, options.workers)
                facts = json.loads((out / "run.json").read_text(encoding="utf-8"))
                print(command, how, *(f"{name} {facts[name]:g}" for name in COUNTS), flush=True)
            different += sum(compare_all(runs[0], other) for other in runs[1:])
    return 1 if different else 0


def run(command: str, config: Path, out: Path, workers: int) -> None:
    """Run a command into a folder."""
    where = ["executor.name=ray", f"executor.workers={workers}"]
    where += ["method.options.differences=auto"] if command == "fit" else []
    arguments = [command, str(config), *where, "--out", str(out), "--no-report"]
    # Ray's workers give way to all others, and would get hardly anything of a busy machine.
    environment = {**os.environ, "RAY_worker_niceness": "0"}
    ended = subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, env=environment, check=False
    )
    if ended.returncode:
        raise SystemExit(f"{command}: exit code {ended.returncode}\n{ended.stderr}")


@contextmanager
def busy(count: int) -> Iterator[str]:
    """Keep some processes busy beside what runs."""
    spin = [sys.executable, "-c", "while True: pass"]
    others = [subprocess.Popen(spin) for _ in range(count)]
    try:
        yield f"beside {count} busy processes:" if count else "alone:"
    finally:
        for other in others:
            other.kill()
            other.wait()


if __name__ == "__main__":
    sys.exit(main())
