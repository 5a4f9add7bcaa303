"""Kill workers and coordinators at random instants and compare the result with an undisturbed run.

    python scripts/chaos.py [--kills 50] [--seconds 2] [--starts 24] [--step 2e-5] [--seed 0]

1. A fit of several thousand simulations on two Ray workers, of whose processes one is killed every
   few seconds on average: it must end with the same bits as the fit that nobody disturbs.
2. A fit whose coordinator is killed at random instants and called again with --resume: the same
   bits, and few simulations run twice. The FMU counts its simulations in a file.

The exit code is 0 if all bits agree.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from build_fmus import build

MODEL = Path(__file__).resolve().parent.parent / "tests" / "fmus" / "lenient_models" / "misbehaves"
TRUE_RATE, NOISE = 0.7, 0.01
STARTS = (1.0, 0.6, -0.4, 0.2)
COUNTED = "SIMULATIONS_COUNTED_IN"


def main() -> int:
    """Run all three fits and compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="of the coordinator")
    parser.add_argument("--seconds", type=float, default=2.0, help="between kills of workers")
    parser.add_argument("--starts", type=int, default=24, help="of the multi-start")
    parser.add_argument("--step", type=float, default=2e-5, help="s; what makes simulations slow")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    generator = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = make_problem(folder, options.starts, options.step)
        undisturbed, usual = run(config, folder / "undisturbed", "processes")
        print(f"undisturbed: {undisturbed:.0f} s, {usual} simulations", flush=True)
        same = kill_workers(config, folder, options.seconds, generator)
        same &= kill_coordinators(config, folder, options.kills, undisturbed, usual, generator)
    return 0 if same else 1


def make_problem(folder: Path, starts: int, step: float) -> Path:
    """Measured decays, the FMU, and a config for a multi-start over them."""
    build(MODEL, folder)
    generator = np.random.default_rng(1)
    times = np.linspace(0.0, 2.0, 41)
    experiments = []
    for e, x in enumerate(STARTS):
        y = x * np.exp(-TRUE_RATE * times) + NOISE * generator.standard_normal(len(times))
        rows = [f"{t:.6f},{v:.9f}" for t, v in zip(times, y, strict=True)]
        (folder / f"e{e}.csv").write_text("\n".join(["time,y", *rows]) + "\n", encoding="utf-8")
        experiments.append(
            f'[[experiments]]\nid = "e{e}"\ndata = "e{e}.csv"\ntime = "time"\n'
            'outputs = { y = "y" }\n'
        )
    config = folder / "chaos.toml"
    config.write_text(
        f'[model]\nfmu = "misbehaves.fmu"\nsolver = "rk4"\nstep = {step}\n'
        "[parameters]\n"
        'rate = { start = 1.5, bounds = [0.05, 5.0], scale = "log" }\n'
        'x0 = { start = 0.5, bounds = [-2.0, 2.0], variable = "x", per = "experiment" }\n'
        f"[multistart]\nn = {starts}\n" + "\n".join(experiments),
        encoding="utf-8",
    )
    return config


def command(config: Path, out: Path, executor: str, *more: str) -> list[str]:
    """The command line of a fit."""
    chosen = [f"executor.name={executor}", "executor.workers=2", *more]
    return [sys.executable, "-m", "cluster_est.cli", "fit", str(config), "--out", str(out), *chosen]


def run(config: Path, out: Path, executor: str) -> tuple[float, int]:
    """A fit that nobody disturbs: its seconds, and how many simulations it took."""
    counter = out.with_suffix(".count")
    begin = time.monotonic()
    subprocess.run(
        command(config, out, executor),
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, COUNTED: str(counter)},
    )
    return time.monotonic() - begin, counter.stat().st_size


def kill_workers(config: Path, folder: Path, mean: float, generator: np.random.Generator) -> bool:
    """Part 1; whether the bits are the same."""
    out = folder / "workers_killed"
    fit = subprocess.Popen(
        command(config, out, "ray"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    killed: list[str] = []
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(generator.exponential(mean)):
            found = workers_of(fit.pid)
            if found and (out / "run.json").exists():
                process, kind = found[generator.integers(len(found))]
                if terminate(process):
                    killed.append(kind)

    killer = threading.Thread(target=kill)
    killer.start()
    begin = time.monotonic()
    _, said = fit.communicate()
    ended.set()
    killer.join()
    spent = time.monotonic() - begin
    counts = {kind: killed.count(kind) for kind in sorted(set(killed))}
    print(f"workers killed: {counts} in {spent:.0f} s, exit code {fit.returncode}", flush=True)
    if fit.returncode != 0:
        print(said)
    return compare(folder / "undisturbed", out)


def kill_coordinators(
    config: Path,
    folder: Path,
    kills: int,
    undisturbed: float,
    usual: int,
    generator: np.random.Generator,
) -> bool:
    """Part 2; likewise."""
    out, counter = folder / "coordinator_killed", folder / "coordinator_killed.count"
    done = 0
    while True:
        fit = subprocess.Popen(
            command(config, out, "processes", "--resume"),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, COUNTED: str(counter)},
        )
        try:
            fit.wait(
                generator.uniform(1.0, 2.0 + 2.0 * undisturbed / kills) if done < kills else None
            )
            break
        except subprocess.TimeoutExpired:
            fit.kill()
            fit.wait()
            done += 1
    again = counter.stat().st_size - usual
    print(
        f"coordinator killed {done} times, exit code {fit.returncode}; {again} simulations ran "
        f"twice, {again / max(done, 1):.1f} for each kill",
        flush=True,
    )
    return compare(folder / "undisturbed", out)


def compare(one: Path, other: Path) -> bool:
    """Print whether two runs have the same bits."""
    same = True
    for table in ("parameters", "minima", "searches", "errors", "residuals"):
        tables = [pq.read_table(folder / f"{table}.parquet") for folder in (one, other)]
        equal = tables[0].equals(tables[1]) or repr(tables[0].to_pylist()) == repr(
            tables[1].to_pylist()
        )
        same &= equal
        if not equal:
            print(f"  {table}.parquet differs")
    print("  the same bits" if same else "  NOT the same bits", flush=True)
    return same


def workers_of(process: int) -> list[tuple[int, str]]:
    """Ray actors that descend from a process, and the processes that their FMUs live in."""
    parents = {}
    names = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
                names[int(entry.name)] = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            parents[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    return [
        (pid, "worker" if name.startswith("ray::FmuActor") else "simulation")
        for pid, name in names.items()
        if (name.startswith("ray::FmuActor") or "workers.process.template" in name)
        and descends(pid, process, parents)
    ]


def descends(process: int, ancestor: int, parents: dict[int, int]) -> bool:
    """Whether a process was started by another one, or by one of its own."""
    while process in parents:
        process = parents[process]
        if process == ancestor:
            return True
    return False


def terminate(process: int) -> bool:
    """Kill a process; whether it was there."""
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
