"""What an FMU that crashes, hangs or leaks costs a fit.

    python scripts/bench_faults.py [--starts 32] [--step 3e-5] [--rounds 3]

The same multi-start of a decay on two workers, each in a process of its own: undisturbed, with 5 %
of the rates crashing the FMU, with 2 % of them hanging it, and with a leak of 1 MB a simulation.
Printed are the median wall time over the undisturbed one's (interleaved), without the seconds in
which workers waited for simulations that hung; the largest memory of all processes together; and
how far the estimates are from the undisturbed ones, in standard errors.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from chaos import command, make_problem

from cluster_est.run_folder.evaluation_log import read_log

TROUBLES = {
    "undisturbed": "",
    "5 % crash": "values.kind=1.0 values.share=0.05",
    "2 % hang": "values.kind=4.0 values.share=0.02",
    "leaks 1 MB": "values.leak=1.0",
}
TIMEOUT, WORKERS = 0.5, 2


def main() -> None:
    """Run all of them by turns and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--step", type=float, default=3e-5)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    seconds: dict[str, list[float]] = {name: [] for name in TROUBLES}
    with tempfile.TemporaryDirectory() as folder:
        config = make_problem(Path(folder), options.starts, options.step)
        for turn in range(options.rounds):
            for name, values in TROUBLES.items():
                out = Path(folder) / f"{name} {turn}"
                spent, peak = run(config, out, values.split())
                waited = report(Path(folder) / f"undisturbed {turn}", out, name, spent, peak)
                seconds[name].append(spent - waited)
    clean = statistics.median(seconds["undisturbed"])
    for name, each in seconds.items():
        print(f"{name}: {statistics.median(each) / clean:.2f} of the undisturbed {clean:.1f} s")


def run(config: Path, out: Path, values: list[str]) -> tuple[float, float]:
    """A fit; its seconds, and the most MB that all its processes had at one time."""
    begin = time.monotonic()
    fit = subprocess.Popen(
        command(config, out, "processes", f"executor.timeout={TIMEOUT}", *values),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    peak = [0.0]
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(0.2):
            peak[0] = max(peak[0], megabytes_of(fit.pid))

    watcher = threading.Thread(target=look)
    watcher.start()
    fit.wait()
    ended.set()
    watcher.join()
    return time.monotonic() - begin, peak[0]


def report(undisturbed: Path, out: Path, name: str, spent: float, peak: float) -> float:
    """Print what one fit came to; the seconds for which workers waited in vain."""
    log = read_log(out / "evaluations")
    status = log["status"].to_pylist()
    failed = {each: status.count(each) for each in sorted(set(status) - {"ok"})}
    one, other = (pq.read_table(folder / "parameters.parquet") for folder in (undisturbed, out))
    errors = np.array(one["std_error"].to_pylist(), np.float64)
    away = np.abs(np.array(other["value"].to_pylist()) - np.array(one["value"].to_pylist()))
    waited = float(2 * TIMEOUT * status.count("timeout") / WORKERS)
    print(
        f"{name}: {spent:.1f} s ({waited:.1f} s of them timeouts), {len(status)} simulations, "
        f"failed: {failed or 'none'}, {peak:.0f} MB, at most {np.nanmax(away / errors):.1g} "
        "standard errors away",
        flush=True,
    )
    return waited


def megabytes_of(process: int) -> float:
    """Memory of a process and all that descend from it; what they share counts once for each."""
    parents: dict[int, int] = {}
    sizes: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text().rpartition(")")[2].split()
                sizes[int(entry.name)] = int((entry / "statm").read_text().split()[1])
            except (OSError, IndexError):
                continue
            parents[int(entry.name)] = int(stat[1])
    own = {process}
    for _ in range(4):
        own |= {pid for pid, parent in parents.items() if parent in own}
    return sum(sizes.get(pid, 0) for pid in own) * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    main()
