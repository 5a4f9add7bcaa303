"""The league of measured cases: base model, closed loop and textbook on the same data.

    export CLUSTER_EST_DATA=~/benchmarks
    python scripts/league.py run runs/league [--only rocket ur5e] [--kinds base textbook loop]
    python scripts/league.py page runs/league --to league.md
    python scripts/league.py convert FOLDER

`run` performs the missing runs with default settings: two fits and a closed loop for each case of
`configs/league`, and a fit and a closed loop for each case on an official split. `page` writes the
results, with a picture of each case. `convert` writes the tables that some configs need to a
folder. CLUSTER_EST_CONVERTED must name this folder if these configs are used alone; `run` does this
itself.

The data are not part of this project; see cluster_est/docs/measured_data.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from measured_league.cases import LeagueCase, all_cases, convert, official_cases
from measured_league.page import read_judgements, write_page
from measured_league.runs import DATA, Kind, run_cases


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the requested action."""
    options = parse(arguments)
    if options.action == "convert":
        return _convert(options.folder)
    cases = chosen_cases(options.only)
    if options.action == "page":
        for path in write_page(cases, read_judgements(), options.out, options.to):
            print(path)
        return 0
    kinds = [Kind(kind) for kind in options.kinds]
    failed = 0
    for ended in run_cases(cases, kinds, options.out, options.minutes, options.workers):
        print(f"{ended.case} {ended.kind.value}: {ended.how}", flush=True)
        failed += ended.how != "done"
    return 1 if failed else 0


def chosen_cases(only: Sequence[str]) -> list[LeagueCase]:
    """Return the cases with these names, or all."""
    cases = [*all_cases(), *official_cases()]
    unknown = set(only) - {case.name for case in cases}
    if unknown:
        names = ", ".join(case.name for case in cases)
        raise SystemExit(f"there is no case {sorted(unknown)[0]!r}; there are {names}")
    return [case for case in cases if not only or case.name in only]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    actions = parser.add_subparsers(dest="action", required=True)
    run = actions.add_parser("run", help="do the fits and closed loops that are not done yet")
    run.add_argument("out", type=Path, help="folder of the runs")
    run.add_argument("--kinds", nargs="+", choices=list(Kind), default=list(Kind))
    run.add_argument("--minutes", type=float, default=60.0, help="after which a run is ended")
    run.add_argument("--workers", type=int, default=1, help="simulations at a time")
    page = actions.add_parser("page", help="write what came of them")
    page.add_argument("out", type=Path, help="folder of the runs")
    page.add_argument("--to", type=Path, required=True, help="the Markdown file")
    for each in (run, page):
        each.add_argument("--only", nargs="+", default=[], metavar="CASE")
    tables = actions.add_parser("convert", help="write the tables that some configs need")
    tables.add_argument("folder", type=Path)
    return parser.parse_args(arguments)


def _convert(folder: Path) -> int:
    data = os.environ.get(DATA)
    if data is None:
        print(f"{DATA} must name the folder of the measured data but is not set", file=sys.stderr)
        return 2
    for path in convert(Path(data), folder):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
