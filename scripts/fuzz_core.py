"""Fuzzes the core in C under sanitizers: byte code of any content, and FMUs that misbehave.

    python scripts/fuzz_core.py --runs 1000000 --seed 1

builds `scripts/fuzzing/core` with clang and its libFuzzer (Debian: apt install clang
libclang-rt-14-dev) and runs each fuzzer, starting from the inputs in
`tests/integration/core/fuzzed`. The exit code is 1 if a fault was found; its input is stored in the
folder of --keep. After a fault is corrected, its input should be added to those inputs.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from workers.core import build  # noqa: E402

SOURCES = Path(__file__).parent / "fuzzing" / "core"
KNOWN = ROOT / "tests" / "integration" / "core" / "fuzzed"
"""Initial inputs, in a folder for each fuzzer: some programs, and inputs of earlier faults."""
FUZZERS = {"programs": 1024, "fmus": 512}
"""The fuzzers, with the bytes of their longest inputs."""
FLAGS = (
    "-std=c11", "-O1", "-g", "-ffp-contract=off", "-fno-math-errno", "-foptimize-sibling-calls",
    "-fno-sanitize-recover=all", "-Wall", "-Wextra", "-Werror",
)  # fmt: skip
SANITIZERS = {"address": "address,undefined", "memory": "memory"}
"""The second one detects uninitialised values; only clang supports it."""
SECONDS_OF_ONE = 30


def sources(fuzzer: str, *others: str) -> list[Path]:
    """Return the source files of a fuzzer, including the core's."""
    own = [
        SOURCES / f"{name}.c"
        for name in ("tape", "stub", "integrator", "machines", fuzzer, *others)
    ]
    return [*own, *build.sources("core")]


def build_fuzzer(clang: str, fuzzer: str, target: Path, sanitizers: str = "address") -> bool:
    """Build a fuzzer; return False if clang has no libFuzzer."""
    asked = f"-fsanitize=fuzzer,{SANITIZERS[sanitizers]}"
    linked = (f"-I{build.HERE}", "-lm", "-ldl")
    command = [clang, *FLAGS, asked, *map(str, sources(fuzzer)), *linked]
    done = subprocess.run(
        [*command, "-o", str(target)], capture_output=True, text=True, check=False
    )
    if done.returncode and "libclang_rt.fuzzer" not in done.stderr:
        raise SystemExit(done.stderr)
    return done.returncode == 0


def run_fuzzer(
    binary: Path, fuzzer: str, corpus: Path, runs: int, seed: int
) -> subprocess.CompletedProcess[str]:
    """Run a fuzzer with a number of inputs from a seed; store new inputs and faults in a folder.

    Return its result; its exit code is 0 if no fault was found. A shell starts it, because Linux
    counts the parent's memory as the maximum of a new process, which libFuzzer limits.
    """
    command = [
        "sh", "-c", '"$@"; exit $?', "sh",
        str(binary), f"-runs={runs}", f"-seed={seed}", f"-max_len={FUZZERS[fuzzer]}",
        f"-timeout={SECONDS_OF_ONE}", f"-artifact_prefix={corpus.parent}/{fuzzer}-",
    ]  # fmt: skip
    folders = [str(corpus), str(KNOWN / fuzzer)]
    return subprocess.run(
        [*command, *folders], capture_output=True, text=True, check=False, env=surroundings()
    )


def surroundings() -> dict[str, str]:
    """Return the environment of a fuzzer, with the path of fmpy's CVODE for this platform."""
    found = importlib.util.find_spec("fmpy")
    if found is None or found.origin is None:
        return dict(os.environ)
    folder = Path(found.origin).parent / "sundials" / build.this_platform()
    return os.environ | ({"FUZZED_SUNDIALS": str(folder)} if folder.is_dir() else {})


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("fuzzers", nargs="*", choices=[*FUZZERS, []], metavar="FUZZER")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sanitizers", choices=list(SANITIZERS), default="address")
    parser.add_argument("--keep", type=Path, help="folder for inputs; default: a new one")
    options = parser.parse_args(arguments)
    clang = shutil.which("clang")
    if clang is None:
        raise SystemExit("there must be clang, which has libFuzzer, but there is none; install it")
    keep = options.keep or Path(tempfile.mkdtemp(prefix="fuzz-core-"))
    worst = 0
    for fuzzer in options.fuzzers or FUZZERS:
        corpus = keep / fuzzer
        corpus.mkdir(parents=True, exist_ok=True)
        if not build_fuzzer(clang, fuzzer, keep / f"{fuzzer}.bin", options.sanitizers):
            raise SystemExit(f"{clang}: must have libFuzzer but has not; install libclang-rt-dev")
        done = run_fuzzer(keep / f"{fuzzer}.bin", fuzzer, corpus, options.runs, options.seed)
        print(f"{fuzzer}: {'something was found' if done.returncode else 'nothing was found'}")
        print("\n".join(done.stderr.splitlines()[-40 if done.returncode else -2 :]), flush=True)
        worst = max(worst, int(done.returncode != 0))
    print(f"inputs are in {keep}")
    return worst


if __name__ == "__main__":
    sys.exit(main())
