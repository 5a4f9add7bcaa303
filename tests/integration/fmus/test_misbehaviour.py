"""Whatever an FMU does to its process: the same bits as without it, or a sentence; nothing is left.

The model is a decay, `tests/fmus/models/misbehaves`, that does it at a fifth of the rates, once, or
in each call.
"""

import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

KINDS = {
    1: "no number", 2: "infinity", 3: "discard", 4: "error", 5: "fatal error", 6: "any status",
    7: "busy for ever", 8: "asleep for ever", 9: "exit(0)", 10: "_exit(0)", 11: "abort",
    12: "address 0", 13: "endless recursion", 14: "leaks 10 MB", 15: "overwrites the heap",
    16: "another locale", 17: "rounds upward", 18: "denormals are zeros", 19: "traps on infinities",
    20: "another working folder", 21: "ignores signals", 22: "umask 0777", 23: "closes the streams",
    24: "closes all files", 25: "leaves a process", 26: "forks itself", 27: "prints 64 MB",
    28: "busy threads", 29: "changes after some calls", 30: "never repeats", 31: "keeps a state",
    32: "depends on the calls before", 33: "ends its parent", 34: "stops itself",
    35: "has a second of processor time", 36: "has four files", 37: "kills itself",
    38: "has an alarm", 39: "ends its group", 40: "is slow", 41: "a huge number",
    42: "has a misleading name and sleeps", 43: "rounds downward", 44: "depends on the process",
    45: "depends on the clock",
}  # fmt: skip
"""As the model numbers them."""
CHANGING = {29, 30, 31, 32, 44, 45}
"""Those whose simulations do not depend on their inputs alone, which must be said."""
ENDLESS = {7, 8, 40, 42}
"""In the process of the command nobody ends what does not end, or ends hardly ever."""
TIMES = 0.05 * np.arange(41)
DEFAULT = {("local", 10, 2), ("local", 26, 2), ("processes", 26, 3)}
CASES = [
    pytest.param(
        *(executor, kind, fmi),
        marks=() if (executor, kind, fmi) in DEFAULT else pytest.mark.slow,
        id=f"{executor}-{KINDS[kind]}-{fmi}",
    )
    for executor, fmi, kinds in (
        ("local", 2, {*KINDS} - ENDLESS),
        ("processes", 3, {*KINDS}),
        ("ray", 2, {1, 8, 10, 26, 33, 39, 44}),
    )
    for kind in sorted(kinds)
]
CONFIG = """
[model]
fmu = "{fmu}"
[parameters]
rate = {{ start = 1.5, bounds = [0.05, 5.0], scale = "log" }}
[values]
kind = {kind}.0
share = 0.2
[executor]
name = "{executor}"
timeout = 1.0
[[experiments]]
id = "a"
data = "a.csv"
time = "time"
outputs.y = "y"
sigma.y = 0.01
"""


def started_with(marker: str) -> list[str]:
    """The processes that have this in their environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if marker.encode() in (process / "environ").read_bytes():
                found.append(process.name)
        except OSError:  # it has ended
            continue
    return found


@pytest.fixture(scope="module")
def fit_of(own_fmu, tmp_path_factory):
    """Fit by the command, in a session of its own: how it ends, what it says, the rate's row."""

    @cache
    def fit(executor, kind, fmi):
        folder = tmp_path_factory.mktemp("misbehaves")
        noise = 0.01 * np.random.default_rng(0).standard_normal(len(TIMES))
        rows = np.column_stack([TIMES, np.exp(-0.7 * TIMES) + noise])
        np.savetxt(folder / "a.csv", rows, delimiter=",", header="time,y", comments="")
        text = CONFIG.format(fmu=own_fmu("misbehaves", fmi), kind=kind, executor=executor)
        (folder / "config.toml").write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "cluster_est", "fit", str(folder / "config.toml")]
        with (folder / "said").open("wb") as file:
            ended = subprocess.run(
                [*command, "--out", str(folder / "run"), "--no-report"],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                check=False,
                env={**os.environ, "MISBEHAVES": str(folder)},
                start_new_session=True,
                timeout=300,
            )
        said = (folder / "said").read_bytes()[-100_000:].decode(errors="replace")
        give_up = time.monotonic() + 10.0  # workers end when they see that they have no parent
        while (left := started_with(str(folder))) and time.monotonic() < give_up:
            time.sleep(0.1)
        table = folder / "run" / "parameters.parquet"
        row = pq.read_table(table).to_pylist()[0] if table.is_file() else None
        return ended.returncode, " ".join(said.split()), left, row

    return fit


@pytest.mark.parametrize(("executor", "kind", "fmi"), CASES)
def test_it_ends_with_the_same_estimate_or_a_sentence(fit_of, executor, kind, fmi):
    code, said, left, row = fit_of(executor, kind, fmi)
    assert left == []
    # without files Python itself cannot end in silence
    assert "Traceback" not in said or (executor, kind) == ("local", 24)
    if code != 0:
        # what ends its parent or its group has asked the command to end, as a user does
        words = ("cluster-est: ", "not converged", "interrupted")
        assert kind == 23 or any(each in said for each in words)
        return
    _, _, _, expected = fit_of(executor, 0, fmi)
    if kind in CHANGING:
        assert "is not repeatable" in said or "keeps data" in said or "once more" in said
    else:
        assert abs(row["value"] - expected["value"]) < 1e-3 * expected["std_error"]
