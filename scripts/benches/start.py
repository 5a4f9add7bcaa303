"""How long a user waits before something is on the screen.

CPU seconds (user and system, of the command and its children), wall seconds and those until
anything is printed, each the median of the `rounds`: of the help, of `show`, of `init`, of the
import from Python, and of a fit and `check` of the embedded example, warm, with the simulation core
in a cache, and cold, with an empty one. The last row has the size of the report. All is done on
copies in a temporary folder.
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
from collections.abc import Iterator, Sequence
from pathlib import Path

from benches import Row
from benches.common import CONFIGS, ROOT

OPTIONS = {"rounds": 5}
PROGRAM = (sys.executable, "-m", "cluster_est.cli")


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each command."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(CONFIGS, folder / "configs")
        config = str(folder / "configs" / "mass_spring_damper.toml")
        table = str(folder / "configs" / "data" / "mass_spring_damper" / "exp1.csv")
        model = str(folder / "configs" / "models" / "mass_spring_damper.fmu")
        run, new = folder / "run", str(folder / "new.toml")
        fit = [*PROGRAM, "fit", config, "--out", str(run), "--overwrite"]
        measured(fit, folder)  # fills the cache
        warm = {
            "help": [*PROGRAM, "--help"],
            "show": [*PROGRAM, "show", str(run)],
            "init": [*PROGRAM, "init", model, table, "--out", new, "--overwrite"],
            "import": [sys.executable, "-c", "import cluster_est"],
            "fit, warm": fit,
        }
        cold = {"fit, cold": fit, "check, cold": [*PROGRAM, "check", config]}
        for what, command in (warm | cold).items():
            found = [measured(command, folder, cold=what in cold) for _ in range(options.rounds)]
            processor, wall, first = map(statistics.median, zip(*found, strict=True))
            yield {"command": what, "CPU s": processor, "s": wall, "output after s": first}
        yield {"report MB": (run / "report.html").stat().st_size / 1e6}


def measured(
    command: Sequence[str], folder: Path, *, cold: bool = False
) -> tuple[float, float, float]:
    """CPU and wall seconds of a command, and until its first output.

    With `cold`, with an empty cache: the core is built, and the FMU unpacked.
    """
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    if cold:
        environment["CLUSTER_EST_CACHE"] = tempfile.mkdtemp(dir=folder)
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
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
    return used, wall, first if said else wall
