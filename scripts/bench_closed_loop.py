"""Run the closed loop on systems that lack an effect, and score what it says against the truth.

    python scripts/bench_closed_loop.py --out results.jsonl --split tune --every 10
    python scripts/bench_closed_loop.py --out fast.jsonl --kinds single,clean --every 30 --rate 10
    python scripts/bench_closed_loop.py --out results.jsonl --page closed-loop-benchmark.md
    python scripts/bench_closed_loop.py --compare old.jsonl new.jsonl
    python scripts/bench_closed_loop.py --out results.jsonl --kinds pair --ablation all

The first prints one line a case and appends to the file, one record a line; cases that are in it
already are skipped, so a run can be continued. The second samples the cases ten times as fast, in
noise that is larger by the root of ten. The third writes the tables of all that is there. The
fourth lists the cases of both files that were right and are no longer; there must be none, and the
exit code is 1 if there is one. The last runs the cases as they are, and with each part of the
search (a move, a gate, or what moves share) left out alone, each into a file beside that of
`--out`, and prints the parts side by side.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import queue
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from closed_loop_benchmark.data import Sampling, make, make_problem
from closed_loop_benchmark.oracle import ask
from closed_loop_benchmark.scenarios import Kind, Scenario, all_scenarios
from closed_loop_benchmark.scoring import Score, blank, score
from closed_loop_benchmark.system import Split
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.tables import compare_runs, one_line, page, paired

from cluster_est.closed_loop.loop import close_loop
from cluster_est.closed_loop.settings import LoopPart, LoopSettings
from cluster_est.problem.thinning import ThinningSettings


@dataclass(frozen=True)
class Way:
    """How all cases are sampled, and what is asked of their loops."""

    settings: LoopSettings
    sampling: Sampling
    thinning: ThinningSettings


ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    """Do what the arguments ask for; 1 if a comparison finds a case that is no longer right."""
    options = parse()
    if options.compare:
        text, lost = compare_runs(*(read(file) for file in options.compare))
        print(text)
        return int(lost > 0)
    if options.page:
        own = read(options.out)
        variants = {label: read(Path(file)) for label, file in options.variant}
        text = page(list(own.values()), {"as it is": own, **variants} if variants else {})
        options.page.write_text(text, encoding="utf-8")
        return 0
    whole = complete(options, options.out, options.without)
    if options.ablation:
        runs = {"as it is": whole}
        for part in options.ablation:
            file = options.out.with_name(f"{options.out.stem}.without {part}.jsonl")
            runs[part] = complete(options, file, (*options.without, part))
        print(paired(runs))
    return 0


def complete(options: argparse.Namespace, out: Path, without: Sequence[str]) -> dict[str, Score]:
    """Run what a file lacks, and return the records of all cases that were asked for."""
    done = read(out)
    if options.again:
        done = {name: known for name, known in done.items() if not known.error}
    chosen = choose(options)
    cases = [case for case in chosen if case.name not in done]
    print(f"{out}: {len(cases)} cases to run, {len(done)} are there already", flush=True)
    rows = options.rows if options.rows in ("auto", "no") else int(options.rows)
    way = Way(
        LoopSettings(beam=options.beam, without=tuple(without)),
        Sampling(options.rate, options.jitter),
        ThinningSettings(rows=rows),
    )
    with out.open("a", encoding="utf-8") as file:
        for one in run(cases, options, way):
            file.write(one.to_json() + "\n")
            file.flush()
            print(one_line(one), flush=True)
            done[one.name] = one
    return {case.name: done[case.name] for case in chosen if case.name in done}


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results.jsonl"), help="file of records")
    parser.add_argument("--page", type=Path, help="write this Markdown page and run nothing")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("OLD", "NEW"), help="two files; run nothing"
    )
    parser.add_argument(
        "--variant",
        nargs=2,
        action="append",
        default=[],
        metavar=("LABEL", "FILE"),
        help="of the same cases with a part switched off, for the page; may be repeated",
    )
    parser.add_argument("--kinds", type=names_of(get_args(Kind)), default=get_args(Kind))
    parser.add_argument("--systems", type=names_of(tuple(SYSTEMS)), default=tuple(SYSTEMS))
    parser.add_argument("--split", choices=get_args(Split))
    parser.add_argument("--cases", nargs="+", default=(), metavar="NAME", help="these alone")
    parser.add_argument("--every", type=int, default=1, help="of the cases, spread over all sorts")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="then start no case")
    parser.add_argument("--beam", type=int, default=LoopSettings().beam, help="closed_loop.beam")
    parts = tuple(part.value for part in LoopPart)
    parser.add_argument(
        "--without", type=names_of(parts), default=(), help="parts of the search to leave out"
    )
    parser.add_argument(
        "--ablation",
        type=lambda text: parts if text == "all" else names_of(parts)(text),
        default=(),
        help='parts to leave out one at a time, with commas between them, or "all"',
    )
    parser.add_argument("--rate", type=int, default=1, help="samples for each, in as much noise")
    parser.add_argument("--jitter", type=float, default=0.0, help="of sample times, over a step")
    parser.add_argument("--rows", default="auto", help='thinning.rows: "auto", "no" or a number')
    parser.add_argument("--again", action="store_true", help="repeat cases that failed")
    return parser.parse_args()


def names_of(known: tuple[str, ...]) -> Any:
    """Return a reader of names with commas between them."""

    def read_names(text: str) -> tuple[str, ...]:
        names = tuple(text.split(","))
        for name in names:
            if name not in known:
                raise argparse.ArgumentTypeError(f"must be of {', '.join(known)} but is {name!r}")
        return names

    return read_names


def read(path: Path) -> dict[str, Score]:
    """Return the records of a file by case; of several of one case, the last."""
    if not path.is_file():
        return {}
    scores = map(Score.from_json, path.read_text(encoding="utf-8").splitlines())
    return {one.name: one for one in scores}


def choose(options: argparse.Namespace) -> list[Scenario]:
    """Return the cases that are asked for."""
    cases = [
        case
        for case in all_scenarios()
        if case.kind in options.kinds
        and case.system in options.systems
        and options.split in (None, case.split)
    ]
    # By seed within a system and kind: every third of the listed cases would be of one size.
    cases.sort(key=lambda case: (case.kind, case.system, case.seed))
    cases = [case for case in cases if not options.cases or case.name in options.cases]
    return cases[:: options.every]


def run(cases: Sequence[Scenario], options: argparse.Namespace, way: Way) -> Iterator[Score]:
    """Run cases in some processes, and give the score of each as it ends.

    All cases of a portion run in one process, which keeps what it has compiled for their system. A
    case in which a process dies has an error as its score; what its portion had left is not run.
    """
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    deadline = time.time() + options.seconds
    scores: queue.SimpleQueue[Score | None] = queue.SimpleQueue()

    def run_portion(portion: Sequence[Scenario]) -> None:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            for case in portion:
                if time.time() > deadline:
                    return
                try:
                    scores.put(process.submit(run_case, case, way).result())
                except BrokenProcessPool as error:
                    scores.put(blank(make(case, way.sampling), f"the process died: {error}"))
                    return

    portions = divide(cases, options.processes)
    with ThreadPoolExecutor(options.processes) as threads:
        ended = [threads.submit(run_portion, portion) for portion in portions]
        for each in ended:
            each.add_done_callback(lambda _: scores.put(None))
        for _ in ended:
            yield from iter(scores.get, None)
        for each in ended:
            each.result()  # an error in a thread must not go unseen


def divide(cases: Sequence[Scenario], processes: int) -> list[list[Scenario]]:
    """Divide cases by system, the largest portion first, into no less portions than processes."""
    systems = sorted({case.system for case in cases})
    parts = -(-processes // max(len(systems), 1))
    whole = [[case for case in cases if case.system == system] for system in systems]
    portions = [own[part::parts] for own in whole for part in range(parts)]
    return sorted((p for p in portions if p), key=len, reverse=True)


def run_case(case: Scenario, way: Way) -> Score:
    """Close the loop on a case and score it; its seconds are those of the processor."""
    data = make(case, way.sampling)
    try:
        problem, begin = make_problem(data), time.process_time()
        result = close_loop(problem, settings=way.settings, thinning=way.thinning)
        result = replace(result, seconds=time.process_time() - begin)
        return score(data, result, ask(data, result.before.problem))
    except Exception:  # one bad case must not end the others, and its traceback is kept
        return blank(data, traceback.format_exc())


if __name__ == "__main__":
    raise SystemExit(main())
