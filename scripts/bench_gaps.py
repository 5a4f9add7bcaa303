"""Fit records with gaps, and count unreported gaps and wrong parameters.

    python scripts/bench_gaps.py --out results.jsonl
    python scripts/bench_gaps.py --out held.jsonl --held-back
    python scripts/bench_gaps.py --page results.jsonl

The first command fits the 100 open cases, and the second the 100 cases that must not be used for
tuning. Results are appended to the file, and cases in it are skipped. The third command prints the
figures of a file.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gap_benchmark.cases import CASES, Case, Record, make_case

from cluster_est import Resources, fit, read_problem
from cluster_est.errors import ClusterEstError
from cluster_est.preflight.all_checks import run_checks
from workers.fmu.description import describe

MODELS = Path(__file__).resolve().parent.parent / "configs" / "models"
OFF = 4.0
"""Number of standard errors from the truth above which a parameter is wrong."""
WORDS = re.compile(r"\bgap|missing|interpolated|pause")
INTERVALS = re.compile(r"from (-?[\d.e+-]+) to (-?[\d.e+-]+) s")
MORE = re.compile(r"and \d+ more")


def main() -> None:
    """Run the requested action."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gaps.jsonl"), help="file of records")
    parser.add_argument("--held-back", action="store_true", help="the cases with odd numbers")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases")
    parser.add_argument("--page", type=Path, help="print the figures of this file, run nothing")
    options = parser.parse_args()
    if options.page:
        print(page([json.loads(line) for line in options.page.read_text().splitlines()]))
        return
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    done = {json.loads(line)["number"] for line in lines}
    numbers = options.only or range(1 if options.held_back else 0, CASES, 2)
    with options.out.open("a", encoding="utf-8") as file:
        for number in numbers:
            if number not in done:
                one = run(make_case(number))
                file.write(json.dumps(one) + "\n")
                file.flush()
                print(one_line(one), flush=True)


def run(case: Case) -> dict[str, Any]:
    """Check and fit a case as a user would, from a config and tables."""
    found: dict[str, Any] = {"number": case.number, "name": case.name, "error": ""}
    with tempfile.TemporaryDirectory() as folder:
        path = write(case, Path(folder))
        try:
            problem = read_problem(path)
            checks = run_checks(problem, Resources(executor="local"), 0.0).findings
            said = [f"{each.found} {each.do}" for each in checks]
            result = fit(problem, resources=Resources(executor="local"))
        except ClusterEstError as error:
            return found | {"error": str(error), "gaps": _count(case)}
    rows = {each.label: each for each in result.estimates}
    off, errors = {}, {}
    for name, true in case.system.parameters.items():
        row = rows[name]
        off[name] = (row.value - true) / row.std_error if row.std_error > 0.0 else None
        errors[name] = (row.value - true) / true
    return found | {
        "gaps": _count(case),
        "told_by_check": _told(case, said),
        "told_by_fit": _told(case, result.notes),
        "false_alarms": 0 if _count(case) else sum(bool(WORDS.search(s)) for s in said),
        "off": off,
        "errors": errors,
        "rms": result.rmse("train"),
        "unknowns": len(result.solution.x),
        "evaluations": result.evaluations,
        "status": result.status,
    }


def write(case: Case, folder: Path) -> Path:
    """Write the tables of a case and its config."""
    system, lines = case.system, []
    known = describe(system.fmu, (MODELS / system.fmu).read_bytes()).variables
    lines += ["[model]", f'fmu = "{(MODELS / system.fmu).as_posix()}"']
    lines += [f'interface = "{system.interface}"', "", "[values]"]
    lines += [f"{name} = {value!r}" for name, value in system.constants.items()]
    lines += ["", "[parameters]"]
    for name, start in case.starts.items():
        low, high = sorted((start / 4.0, start * 4.0))
        lines.append(f"{name} = {{ start = {start!r}, bounds = [{low!r}, {high!r}] }}")
    for state, guess in case.guesses.items():
        more = f'variable = "{state}", per = "experiment"'
        lines.append(f"{state}_start = {{ start = {guess!r}, {more} }}")
    for record in case.records:
        _table(case, record, folder)
        lines += ["", "[[experiments]]", f'id = "{record.id}"', f'data = "{record.id}.csv"']
        how = "hold" if case.held else "linear"
        columns = [f'{n} = {{ column = "{n}", interpolation = "{how}" }}' for n in system.inputs]
        lines += ['time = "t"', f"inputs = {{ {', '.join(columns)} }}"]
        lines.append(_inline("outputs", {n: f'"{n}"' for n in system.outputs}))
        lines.append(_inline("sigma", dict(zip(system.outputs, case.sigma.tolist(), strict=True))))
        given = {
            s: v for s, v in record.starts.items() if s not in case.unknown and known[s].start != v
        }
        lines.append(_inline("values", given))
    text = "\n".join(lines) + "\n"
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _inline(key: str, entries: Mapping[str, Any]) -> str:
    return f"{key} = {{ {', '.join(f'{name} = {each}' for name, each in entries.items())} }}"


def _table(case: Case, record: Record, folder: Path) -> None:
    head = ",".join(["t", *case.system.inputs, *case.system.outputs])
    rows = np.column_stack([record.times, record.inputs, record.outputs])
    lines = [",".join("" if np.isnan(v) else repr(v) for v in row) for row in rows.tolist()]
    (folder / f"{record.id}.csv").write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")


def _count(case: Case) -> int:
    return sum(len(record.gaps) for record in case.records)


def _told(case: Case, sentences: Sequence[str]) -> int:
    """Return the number of gaps that a sentence names, by experiment and time."""
    told = 0
    for record in case.records:
        own = [s for s in sentences if record.id in s and WORDS.search(s)]
        spans = [(float(a), float(b)) for s in own for a, b in INTERVALS.findall(s)]
        more = any(MORE.search(s) for s in own)
        told += sum(
            more or any(a < last and first < b for a, b in spans) for first, last, _ in record.gaps
        )
    return told


def one_line(one: dict[str, Any]) -> str:
    """Return the result of a case in one line."""
    if one["error"]:
        return f"{one['name']}: {one['error']}"
    worst = max((abs(v) for v in one["off"].values() if v is not None), default=np.nan)
    told = f"{one['told_by_check']} and {one['told_by_fit']} of {one['gaps']} gaps told"
    return f"{one['name']}: {told}; worst {worst:.2f} SE, rms {one['rms']:.3f}, {one['status']}"


def page(cases: Sequence[dict[str, Any]]) -> str:
    """Return the figures of all cases."""
    good = [one for one in cases if not one["error"]]
    values = [v for one in good for v in one["off"].values()]
    known = np.array([v for v in values if v is not None])
    gaps = sum(one["gaps"] for one in cases)
    wrong = [one["name"] for one in good if any(v and abs(v) > OFF for v in one["off"].values())]
    sizes = np.array([abs(v) for one in good for v in one["errors"].values()])
    return "\n".join(
        [
            f"{len(cases)} cases, {len(cases) - len(good)} with an error, {gaps} gaps",
            f"gaps not told of: {gaps - sum(one['told_by_check'] for one in good)} by check, "
            f"{gaps - sum(one['told_by_fit'] for one in good)} by fit",
            f"cases without a gap that are told of one: {sum(o['false_alarms'] > 0 for o in good)}",
            f"parameters beyond {OFF:g} standard errors: {int((abs(known) > OFF).sum())} of "
            f"{len(values)} ({len(values) - len(known)} not determined), in {len(wrong)} cases",
            f"relative error of a parameter: median {np.median(sizes):.3g}, 90 % below "
            f"{np.quantile(sizes, 0.9):.3g}, largest {sizes.max():.3g}",
            f"root mean square residual above 1.2 sigma: {sum(o['rms'] > 1.2 for o in good)} cases",
        ]
    )


if __name__ == "__main__":
    main()
