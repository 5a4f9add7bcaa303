"""Instructions of the core over those of loops by hand, counted by callgrind.

    python scripts/bench_core.py [--cc "gcc"] [--seconds]

The counts are for one simulation of mass_spring_damper with a thousand samples, including the FMU.
The hand-written loops in `bench_core.c` are for this model only. Needs valgrind.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import defaultdict
from pathlib import Path

import sympy as sp

from workers.core import build
from workers.core.assemble import Assignment, EffectArray, Locations, Registers, assemble
from workers.core.library import LoadedProgram
from workers.core.sundials import libraries

HERE = Path(__file__).parent
FMU = HERE.parent / "configs" / "models" / "mass_spring_damper.fmu"
GUID = "{01341437c0c5c22047a80eb1323446ca}"
TERM = (
    "-(k0 + k1 * Abs(v) + k2 * v * v + k3 * x * x) * tanh(v / width)"
    " - k4 * v * Abs(v) + k5 * x * x * x"
)
PAIRS = (
    ("co-simulation", "co", "co-tight", 1.05),
    ("Runge-Kutta", "rk4", "rk4-tight", 1.10),
    ("Dormand-Prince", "dp", "dp-tight", 1.15),
    ("CVODE", "cvode", "cvode-tight", 1.15),
    ("co-simulation with a bound", "co-bound", "co-tight", None),
    ("Runge-Kutta with a bound", "rk4-bound", "rk4-tight", None),
    ("Runge-Kutta, two steps an interval", "rk4-half", "rk4", None),
    ("Runge-Kutta with an effect, over its hook", "rk4+", "rk4-hook+", 1.30),
    ("Dormand-Prince with an effect, over its hook", "dp+", "dp-hook+", 1.30),
)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--seconds", action="store_true", help="processor time of a run, too")
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, library = made(folder)
        (folder / "term.bin").write_bytes(term())
        os.environ["SUNDIALS"] = " ".join(part._name for part in libraries())
        counts = {}
        for title, ours, theirs, bar in PAIRS:
            for what in (ours, theirs):
                if what not in counts:
                    counts[what] = count(program, library, what, folder)
            (one, own), (other, others) = counts[ours], counts[theirs]
            ratio = one / other
            verdict = "" if bar is None else f" (bar {bar:.2f}{'' if ratio <= bar else ': MISSED'})"
            print(f"{title}: {one} / {other} = {ratio:.3f}{verdict}", end="")
            print(f"; without the FMU {own} / {others}", flush=True)
        if options.seconds:
            for what in counts:
                print(f"{what}: {1e6 * seconds(program, library, what, folder):.0f} us a process")


def made(folder: Path) -> tuple[Path, Path]:
    """Return the measured program, and the FMU's library."""
    program = folder / "bench_core"
    flags = [f for f in build.FLAGS if f not in ("-fPIC", "-shared", "-std=c11")]
    build.compile_to(program, [*build.sources(), HERE / "bench_core.c"], [*flags, "-std=gnu11"])
    with zipfile.ZipFile(FMU) as archive:
        archive.extractall(folder)
    return program, folder / "binaries" / "linux64" / "mass_spring_damper.so"


def term() -> bytes:
    """Return the effect: 20 operations including one tanh."""
    names = ("k0", "k1", "k2", "k3", "k4", "k5", "width")
    symbols = {name: sp.Symbol(name, real=True) for name in (*names, "x", "v")}
    locations: Locations = {
        symbols[name]: (EffectArray.COEFFICIENTS, i) for i, name in enumerate(names)
    }
    locations |= {symbols["x"]: (EffectArray.STATES, 0), symbols["v"]: (EffectArray.STATES, 1)}
    added = Assignment(EffectArray.DERIVATIVES, 1, sp.sympify(TERM, symbols), add=True)
    registers = Registers(states=2, own=0, inputs=1, coefficients=len(names))
    code = assemble(registers, locations, after=[added])
    LoadedProgram(code)
    return code


def command(program: Path, library: Path, what: str, folder: Path) -> list[str]:
    effect = [str(folder / "term.bin")] if what.endswith("+") else []
    return [str(program), str(library), GUID, what.removesuffix("+"), *effect]


def count(program: Path, library: Path, what: str, folder: Path) -> tuple[int, int]:
    """Return the instructions of one simulation, and those outside the FMU."""
    out = folder / "callgrind.out"
    counting = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
    counting += ["--collect-atstart=no", "--toggle-collect=measured"]
    done = subprocess.run(
        [*counting, *command(program, library, what, folder)], capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if done.returncode != 0:
        sys.exit(done.stderr[-2000:])
    by_object = totals(out.read_text())
    own = sum(n for name, n in by_object.items() if name != library.name)
    return sum(by_object.values()) // 2, own // 2


def totals(text: str) -> dict[str, int]:
    """Return the sum of callgrind's own costs by object file.

    A line after calls= belongs to another function.
    """
    names: dict[str, str] = {}
    found: dict[str, int] = defaultdict(int)
    current, is_call = "", False
    for line in text.splitlines():
        if named := re.match(r"(c?)ob=\((\d+)\)(?: (.*))?$", line):
            names.setdefault(named[2], Path(named[3] or "").name)
            current = current if named[1] else names[named[2]]
        elif line.startswith("calls="):
            is_call = True
        elif re.match(r"[+*\-\d]", line):
            found[current] += 0 if is_call else int(line.split()[1])
            is_call = False
    return found


def seconds(program: Path, library: Path, what: str, folder: Path) -> float:
    """Return the processor time of a process with two simulations, the smallest of ten."""
    best = float("inf")
    for _ in range(10):
        before = os.times()
        subprocess.run(command(program, library, what, folder), capture_output=True, check=True)
        after = os.times()
        best = min(best, after.children_user - before.children_user)
        time.sleep(0.01)
    return best


if __name__ == "__main__":
    main()
