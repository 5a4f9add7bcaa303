"""Try FMUs from elsewhere: check, curve and fit of every archive in a folder.

    python scripts/try_fmus.py FOLDER [--seconds 60] [--points 101] [--only check curve fit]

Folders in FOLDER are the sources that the table at the end counts by. For each archive:

- ``check`` of the FMU alone: ``clean``, ``problems`` or ``refused``, with the sentences;
- for each interface its curve against that of fmpy: ``agrees``, with the largest difference over
  the largest value of that output; ``no reset``, where that holds for a new instance alone, which a
  fit finds out; ``differs``, at how many of the times; ``not repeatable``, where two new processes
  differ, which `check` says too; ``refused``, with the sentence that a user would see; ``alone``,
  where fmpy cannot simulate it, with what that says;
- for each interface and the executors `local` and `processes`, a fit back to a value that was
  planted in a curve of fmpy's: ``returned``, ``elsewhere``, ``out of time``, ``refused`` or
  ``not tried``.

What must never happen is in capitals: ``HANGS``, ``TRACEBACK``, ``DIES IN SILENCE``. The exit code
is 1 if any of these happened or a curve differs. All runs are in processes of their own.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from fmu_trials.commands import check_fmu
from fmu_trials.curve import compare_curves, trial
from fmu_trials.fit import fit_back

from workers.errors import ModelError
from workers.fmu.description import describe

KINDS = ("check", "curve", "fit")
BAD = ("differs", "HANGS", "TRACEBACK", "DIES IN SILENCE")


def main() -> int:
    """Try every archive, print a line for each trial and the table; 1 if one went wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0, help="that each trial may take")
    parser.add_argument("--points", type=int, default=101, help="at which values are compared")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    options = parser.parse_args()
    counts: collections.Counter[tuple[str, str, str]] = collections.Counter()
    for file in sorted(options.folder.rglob("*.fmu")):
        place = file.relative_to(options.folder)
        source = place.parts[0] if len(place.parts) > 1 else "."
        for what, found in tried(file, options.seconds, options.points, options.only):
            counts[source, what, found.partition(":")[0].partition(" (")[0]] += 1
            print(f"{place}  {what}  {found}", flush=True)
    print()
    for (source, what, found), count in sorted(counts.items()):
        print(f"{source:24} {what:34} {found:24} {count:4}")
    return int(any(found.startswith(BAD) for _, _, found in counts))


def tried(file: Path, seconds: float, points: int, kinds: list[str]) -> Iterator[tuple[str, str]]:
    """Give the name of each trial of an archive, and what came of it."""
    with tempfile.TemporaryDirectory() as folder:
        if "check" in kinds:
            yield "check", check_fmu(file.resolve(), Path(folder), seconds)
        try:
            description = describe(file.name, file.read_bytes())
        except ModelError as error:
            yield "description", f"refused: {error}"
            return
        for interface in description.interfaces:
            given = trial(file, description, interface, points)
            if "curve" in kinds:
                yield f"curve {interface}", compare_curves(given, seconds)
            if "fit" not in kinds or not given.outputs:
                continue
            own = Path(folder, interface)
            own.mkdir()
            for executor, found in fit_back(given, own, seconds).items():
                yield f"fit {interface} {executor}", found


if __name__ == "__main__":
    sys.exit(main())
