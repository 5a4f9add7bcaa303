"""Run the closed loop on systems that lack an effect, and compare its results with the truth.

    python scripts/bench_closed_loop.py --out results.jsonl --split tune --every 10
    python scripts/bench_closed_loop.py --out fast.jsonl --kinds single,clean --every 30 --rate 10
    python scripts/bench_closed_loop.py --out records.jsonl --kinds "single record"
    python scripts/bench_closed_loop.py --out hidden.jsonl --kinds "hidden dynamics" --split tune
    python scripts/bench_closed_loop.py --out hidden.jsonl --hidden-table
    python scripts/bench_closed_loop.py --out results.jsonl --page closed-loop-benchmark.md
    python scripts/bench_closed_loop.py --calibrate claims*.jsonl
    python scripts/bench_closed_loop.py --compare old.jsonl new.jsonl
    python scripts/bench_closed_loop.py --out parts.jsonl --first 60 --ablation drop,waves+bounded
    python scripts/bench_closed_loop.py --out parts.jsonl --parts-page parts_of_the_search.md

1. Prints a line for each case and appends a record to the file. Cases in the file are skipped, so a
   run can be continued.
2. Samples the cases ten times as fast, with noise larger by the root of ten.
3. Runs the cases of one long record.
4. Runs the open half of the cases of hidden dynamics. `--split report` runs the half that is held
   back, and `--kinds "nothing hidden"` their systems with nothing to find.
5. Prints the table of hidden dynamics.
6. Writes the tables of all records.
7. Fits the certainty of claims to the records, and prints the data for the package.
8. Lists the cases of both files that were right and are no longer. There must be none; otherwise
the
   exit code is 1.
9. Tests the parts of the search (moves, gates, and common steps of moves). On each of the first 60
   cases for this purpose, it runs the complete loop, then the loop without the first part, then
   without the two others, and prints the benefit of each. `--ablation all` omits every part in
   turn. Each variant has its own file beside that of `--out`, and can be continued.
10. Writes the page of all records about parts.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import queue
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

from closed_loop_benchmark.activity import noted_parts, saved
from closed_loop_benchmark.claim_calibration import calibration_report, claims_of
from closed_loop_benchmark.data import Data, Sampling, make, make_problem
from closed_loop_benchmark.form_subsets import FormSubset, violations
from closed_loop_benchmark.hidden_dynamics import KINDS as HIDDEN_KINDS
from closed_loop_benchmark.hidden_dynamics import cases_of, hidden_problem, hidden_table
from closed_loop_benchmark.hidden_systems import HIDDEN_SYSTEMS
from closed_loop_benchmark.memory import remembering
from closed_loop_benchmark.oracle import ask
from closed_loop_benchmark.parts import paired, parts_page
from closed_loop_benchmark.scenarios import Kind, Scenario, ablation_cases, all_scenarios
from closed_loop_benchmark.scoring import Score, blank, score
from closed_loop_benchmark.single_records import one_record, single_records
from closed_loop_benchmark.system import Split
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.tables import compare_runs, one_line, page

from cluster_est import Problem
from cluster_est.closed_loop.loop import close_loop
from cluster_est.closed_loop.settings import LoopPart, LoopSettings
from cluster_est.problem.thinning import ThinningSettings


@dataclass(frozen=True)
class Way:
    """Sampling and loop settings of all cases.

    Attributes
    ----------
    settings, sampling, thinning
        See their classes.
    remembers
        Whether to use a cache of simulations of other loops on the same case, and to record the
        active parts of the search.
    subset
        Forms to try on each case; None for the complete library.
    """

    settings: LoopSettings
    sampling: Sampling
    thinning: ThinningSettings
    remembers: bool = False
    subset: FormSubset | None = None

    def settings_for(self, case: Scenario) -> LoopSettings:
        """Return the settings, with the forms drawn for a case if there is a subset."""
        if self.subset is None:
            return self.settings
        return self.settings.changed(effects=self.subset.forms(case))


@dataclass(frozen=True)
class Variant:
    """A way to run cases, the omitted parts, and the file of the records."""

    label: str
    way: Way
    file: Path


WHOLE = "as it is"
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    """Run the requested action; return 1 if a comparison finds a case that is no longer right."""
    options = parse()
    if options.compare:
        text, lost = compare_runs(*(read(file) for file in options.compare))
        print(text)
        return int(lost > 0)
    if options.calibrate:
        scores = (one for file in options.calibrate for one in read(file).values())
        print(calibration_report(claims_of(scores)))
        return 0
    if options.hidden_table:
        print(hidden_table(list(read(options.out).values())))
        return 0
    if options.page:
        text = page(list(read(options.out).values()))
        options.page.write_text(text, encoding="utf-8")
        return 0
    if options.parts_page:
        text = parts_page(read_parts(options.out))
        options.parts_page.write_text(text, encoding="utf-8")
        return 0
    cases = choose(options)
    if options.ablation:
        portions = [cases[n :: options.processes] for n in range(options.processes)]
    else:
        portions = divide(cases, options.processes)
    complete(options, portions, variants_of(options))
    if options.ablation:
        print(paired(read_parts(options.out)))
    if options.subsets:
        print(violations(read_parts(options.out))[0])
    return 0


def variants_of(options: argparse.Namespace) -> list[Variant]:
    """Return the complete loop, and the loops without the parts to omit."""
    rows = options.rows if options.rows in ("auto", "no") else int(options.rows)
    whole = Way(
        LoopSettings(without=options.without),
        Sampling(options.rate, options.jitter),
        ThinningSettings(rows=rows),
        remembers=bool(options.ablation or options.subsets or options.lacking),
    )
    found = [Variant(WHOLE, whole, options.out)]
    for label in options.ablation:
        left_out = whole.settings.changed(without=(*options.without, *label.split("+")))
        file = options.out.with_name(f"{options.out.stem}{WITHOUT}{label}.jsonl")
        found.append(Variant(label, replace(whole, settings=left_out), file))
    subsets = [FormSubset("with", n) for n in range(1, options.subsets + 1)]
    subsets += [FormSubset("lacking", n) for n in range(1, options.lacking + 1)]
    for subset in subsets:
        file = options.out.with_name(f"{options.out.stem}{WITHOUT}{subset.label}.jsonl")
        found.append(Variant(subset.label, replace(whole, subset=subset), file))
    return found


def read_parts(out: Path) -> dict[str, dict[str, Score]]:
    """Return the records of the complete loop, and of all files of loops without parts."""
    opening = f"{out.stem}{WITHOUT}"
    others = {
        file.stem.removeprefix(opening): read(file)
        for file in sorted(out.parent.glob(f"{opening}*.jsonl"))
    }
    return {WHOLE: read(out), **others}


WITHOUT = ".without "


def complete(
    options: argparse.Namespace, portions: Sequence[Sequence[Scenario]], variants: Sequence[Variant]
) -> None:
    """Run the missing cases of the variants."""
    done = {each.label: read(each.file) for each in variants}
    if options.again:
        done = {
            label: {name: known for name, known in own.items() if not known.error}
            for label, own in done.items()
        }
    there = sum(case.name in done[each.label] for p in portions for case in p for each in variants)
    print(f"{sum(map(len, portions)) * len(variants)} loops, {there} are there already", flush=True)
    files = {each.label: each.file for each in variants}
    for label, one in run(portions, variants, done, options):
        with files[label].open("a", encoding="utf-8") as file:
            file.write(one.to_json() + "\n")
        print(one_line(one) if label == WHOLE else f"{one_line(one)}  without {label}", flush=True)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results.jsonl"), help="file of records")
    parser.add_argument("--page", type=Path, help="write this Markdown page and run nothing")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("OLD", "NEW"), help="two files; run nothing"
    )
    parser.add_argument(
        "--calibrate", nargs="+", type=Path, metavar="FILE", help="fit how sure claims are"
    )
    parser.add_argument("--kinds", type=names_of(get_args(Kind)), default=get_args(Kind))
    systems = (*SYSTEMS, *HIDDEN_SYSTEMS)
    parser.add_argument("--systems", type=names_of(systems), default=systems)
    parser.add_argument("--split", choices=get_args(Split))
    parser.add_argument("--cases", nargs="+", default=(), metavar="NAME", help="these alone")
    parser.add_argument("--every", type=int, default=1, help="of the cases, spread over all sorts")
    parser.add_argument("--first", type=int, help="so many of the cases that are left then")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="then start no case")
    parts = tuple(part.value for part in LoopPart)
    parser.add_argument(
        "--without", type=names_of(parts), default=(), help="parts of the search to leave out"
    )
    parser.add_argument(
        "--ablation",
        type=lambda text: parts if text == "all" else groups_of(parts)(text),
        default=(),
        help="parts to leave out one at a time, with commas between them, or all; with + between "
        "them together",
    )
    parser.add_argument(
        "--parts-page", type=Path, help="write the page about parts left out and run nothing"
    )
    parser.add_argument(
        "--hidden-table", action="store_true", help="print that of hidden dynamics and run nothing"
    )
    parser.add_argument(
        "--subsets", type=int, default=0, help="loops with half of the forms, the answer among them"
    )
    parser.add_argument(
        "--lacking", type=int, default=0, help="loops without the forms of an effect that lacks"
    )
    parser.add_argument("--rate", type=int, default=1, help="samples for each, in as much noise")
    parser.add_argument("--jitter", type=float, default=0.0, help="of sample times, over a step")
    parser.add_argument("--rows", default="auto", help='thinning.rows: "auto", "no" or a number')
    parser.add_argument("--again", action="store_true", help="repeat cases that failed")
    return parser.parse_args()


def names_of(known: tuple[str, ...]) -> Any:
    """Return a function that reads names separated by commas."""

    def read_names(text: str) -> tuple[str, ...]:
        names = tuple(text.split(","))
        for name in names:
            if name not in known:
                raise argparse.ArgumentTypeError(f"must be of {', '.join(known)} but is {name!r}")
        return names

    return read_names


def groups_of(known: tuple[str, ...]) -> Any:
    """Return a function that reads groups separated by commas, of names separated by +."""

    def read_groups(text: str) -> tuple[str, ...]:
        for group in text.split(","):
            names_of(known)(group.replace("+", ","))
        return tuple(text.split(","))

    return read_groups


def read(path: Path) -> dict[str, Score]:
    """Return the records of a file by case; of several records of a case, the last."""
    if not path.is_file():
        return {}
    scores = map(Score.from_json, path.read_text(encoding="utf-8").splitlines())
    return {one.name: one for one in scores}


def choose(options: argparse.Namespace) -> list[Scenario]:
    """Return the requested cases: those for parts of the search, or those of the benchmark."""
    known = ablation_cases() if options.ablation else all_scenarios()
    if options.kinds == ("single record",):
        known = single_records()
    if {*options.kinds} <= {*HIDDEN_KINDS}:
        known = [case for kind in options.kinds for case in cases_of(kind)]
    if options.cases:
        hidden = [case for kind in HIDDEN_KINDS for case in cases_of(kind)]
        every = (*all_scenarios(), *ablation_cases(), *single_records(), *hidden)
        known = list({case.name: case for case in every}.values())
    cases = [
        case
        for case in known
        if case.kind in options.kinds
        and case.system in options.systems
        and options.split in (None, case.split)
        and (not options.cases or case.name in options.cases)
    ]
    if not options.ablation:
        # By seed within a system and kind; in listed order, every third case would have the same
        # size.
        cases.sort(key=lambda case: (case.kind, case.system, case.seed))
    return cases[:: options.every][: options.first]


def run(
    portions: Sequence[Sequence[Scenario]],
    variants: Sequence[Variant],
    done: Mapping[str, Mapping[str, Score]],
    options: argparse.Namespace,
) -> Iterator[tuple[str, Score]]:
    """Run cases in several processes, and yield each score with its variant's label.

    All cases of a portion run in one process, which caches compiled effects, and all variants of a
    case run consecutively. If the omitted parts had no influence, the score of a variant follows
    from that of the first variant. If a process dies, the score of its case is an error, and the
    rest of its portion is not run.
    """
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    deadline = time.time() + options.seconds
    scores: queue.SimpleQueue[tuple[str, Score] | None] = queue.SimpleQueue()

    def run_portion(portion: Sequence[Scenario]) -> None:
        for one in scores_of(portion, variants, done, deadline):
            scores.put(one)

    with ThreadPoolExecutor(options.processes) as threads:
        ended = [threads.submit(run_portion, portion) for portion in portions]
        for each in ended:
            each.add_done_callback(lambda _: scores.put(None))
        for _ in ended:
            yield from iter(scores.get, None)
        for each in ended:
            each.result()  # raises the exceptions of threads


def scores_of(
    portion: Sequence[Scenario],
    variants: Sequence[Variant],
    done: Mapping[str, Mapping[str, Score]],
    deadline: float,
) -> Iterator[tuple[str, Score]]:
    """Run the missing variants of some cases in one process, to the end or until a deadline."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        for case in portion:
            whole = done[WHOLE].get(case.name)
            for each in (v for v in variants if case.name not in done[v.label]):
                if time.time() > deadline:
                    return
                known = None if whole is None else known_without(whole, each)
                try:
                    own = known or process.submit(run_case, case, each.way).result()
                except BrokenProcessPool as error:
                    yield each.label, blank(made(case, each.way.sampling)[1], f"it died: {error}")
                    return
                yield each.label, own
                whole = whole or own


def known_without(whole: Score, variant: Variant) -> Score | None:
    """Return the score without parts that had no influence on the complete loop, without seconds.

    The simulations of these parts are subtracted. None if the parts had an influence. An error
    remains an error.
    """
    if variant.way.subset is not None:
        return None
    parts = {*variant.label.split("+")}
    if not whole.error and (whole.active is None or parts & {*whole.active}):
        return None
    left = whole.simulations - saved(whole.spans or [], parts)
    return replace(whole, simulations=left, seconds=math.nan, active=None, spans=None)


def divide(cases: Sequence[Scenario], processes: int) -> list[list[Scenario]]:
    """Divide cases by system into at least as many portions as processes, the largest first."""
    systems = sorted({case.system for case in cases})
    parts = -(-processes // max(len(systems), 1))
    whole = [[case for case in cases if case.system == system] for system in systems]
    portions = [own[part::parts] for own in whole for part in range(parts)]
    return sorted((p for p in portions if p), key=len, reverse=True)


@lru_cache(maxsize=1)
def made(case: Scenario, sampling: Sampling) -> tuple[Problem, Data]:
    """Return the problem and the data of a case, which are common to all its variants."""
    if case.kind == "single record":
        return one_record(case)
    if case.kind in HIDDEN_KINDS:
        return hidden_problem(case)
    data = make(case, sampling)
    return make_problem(data), data


def run_case(case: Scenario, way: Way) -> Score:
    """Close the loop on a case and score it; its seconds are processor time."""
    problem, data = made(case, way.sampling)
    settings = way.settings_for(case)
    try:
        begin = time.process_time()
        if way.remembers:
            with remembering(case.name) as resources, noted_parts() as notes:
                result = close_loop(problem, resources, settings, thinning=way.thinning)
        else:
            result = close_loop(problem, settings=settings, thinning=way.thinning)
        result = replace(result, seconds=time.process_time() - begin)
        own = score(data, result, ask(data, result.before.problem))
    except Exception:  # one failing case must not stop the others; its traceback is stored
        return blank(data, traceback.format_exc())
    if way.remembers:
        return replace(own, active=sorted(notes.active), spans=notes.spans)
    return own


if __name__ == "__main__":
    raise SystemExit(main())
