"""Time the core's elementary functions and the C library's, with and without fused multiply-add.

    python scripts/bench_elementary.py [--rounds 200] [--compiler cc]

For each function, per call: ns of independent calls, ns of calls that depend on each other's
results, and instructions by callgrind (if valgrind is installed). The values of a loop with an
empty function are subtracted. "no FMA" is glibc's variant for a processor without it.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
CORE = HERE.parent / "workers" / "core"
NAMES = ("exp", "expm1", "log", "pow", "sin", "cos", "tan", "atan", "tanh")
WITHOUT_FMA = "glibc.cpu.hwcaps=-FMA,-AVX2"
SIDES = {"core": ("core", ""), "glibc": ("libm", ""), "glibc, no FMA": ("libm", WITHOUT_FMA)}
COUNT = 32768  # as in the C file


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--compiler", default="cc")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "bench"
        sources = [str(HERE / "bench_elementary.c"), str(CORE / "elementary.c")]
        flags = ["-std=gnu11", "-O2", "-ffp-contract=off", f"-I{CORE}"]
        subprocess.run(
            [*options.compiler.split(), *flags, *sources, "-o", str(binary), "-lm"], check=True
        )
        heads = [f"{what}, {side}" for what in ("ns", "ns waiting", "Ir") for side in SIDES]
        print("| | " + " | ".join(heads) + " |\n" + "|---" * (len(heads) + 1) + "|")
        idle = figures(binary, "nothing", options.rounds)
        for name in NAMES:
            measured = figures(binary, name, options.rounds)
            cells = [f"{a - b:.1f}" for a, b in zip(measured, idle, strict=True)]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def figures(binary: Path, name: str, rounds: int) -> list[float]:
    """Return ns, ns of dependent calls and instructions, for each side."""
    times = [
        [float(t) for t in run([str(binary), name, side, str(rounds)], tunables)[0].split()]
        for side, tunables in SIDES.values()
    ]
    counts = [instructions(binary, name, *side) for side in SIDES.values()]
    return [t[0] for t in times] + [t[1] for t in times] + counts


def instructions(binary: Path, name: str, side: str, tunables: str) -> float:
    """Return the instructions per call, from the difference of two runs."""
    if shutil.which("valgrind") is None:
        return float("nan")
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", str(binary)]
    few, many = (
        int(re.findall(r"Collected : (\d+)", run([*command, name, side, rounds], tunables)[1])[0])
        for rounds in ("1", "3")
    )
    return (many - few) / (4 * COUNT)


def run(command: list[str], tunables: str) -> tuple[str, str]:
    """Return the output of a process on both streams."""
    environment = {**os.environ, "GLIBC_TUNABLES": tunables}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return done.stdout, done.stderr


if __name__ == "__main__":
    main()
