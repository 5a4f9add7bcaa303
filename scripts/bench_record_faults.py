"""Count correctly named faults of records, and sets with a false claim of a fault.

    python scripts/bench_record_faults.py --out open.jsonl
    python scripts/bench_record_faults.py --out held.jsonl --held-back
    python scripts/bench_record_faults.py --out clean.jsonl --kinds clean,effect
    python scripts/bench_record_faults.py --page open.jsonl held.jsonl clean.jsonl

Cases in a file are skipped. A case is fitted, and with `--loop` the loop is closed too. A fault is
named if a sentence contains its kind and its record. It is named first if this is the first
sentence of the loop's summary.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from closed_loop_benchmark.data import make_problem, run_name
from record_fault_benchmark.cases import (
    CLEAN,
    KINDS,
    MISSING,
    OF_EACH,
    Case,
    make_clean,
    make_fault,
    make_missing,
)

from cluster_est import Resources, close_loop, fit
from cluster_est.errors import ClusterEstError

WORDS = {
    "gain": r"times too (large|small)",
    "offset": r"too (high|low)",
    "delay": r"(late|early)\b",
    "sign": r"sign",
    "swapped": r"swapped",
    "clock": r"clock",
    "unit": r"unit",
    "sentinel": r"far from all other values",
    "foreign": r"periodic disturbance",
    "transient": r"initial state .* differs",
}
"""Words that occur only in a sentence on this kind of fault."""
ANY = re.compile(
    r"\bthe record\b|\brecords\b.*\b(fault|first)|periodic disturbance|far from all other values"
)
"""Words of a sentence that claims a fault of a record."""
SET_ASIDE = re.compile(r"they differ from all their neighbours")
"""Words of a loop that excludes samples."""
SETS = (*KINDS, "clean", "effect")


def main() -> None:
    """Run the requested action."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("records.jsonl"), help="file of results")
    parser.add_argument("--held-back", action="store_true", help="the cases that were held back")
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"of {', '.join(SETS)}")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases")
    parser.add_argument("--every", type=int, default=1, help="of the cases")
    parser.add_argument("--loop", action="store_true", help="close the loop too")
    parser.add_argument("--page", type=Path, nargs="+", help="print figures of these, run nothing")
    options = parser.parse_args()
    if options.page:
        print(page([json.loads(s) for path in options.page for s in path.read_text().splitlines()]))
        return
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    done = {json.loads(line)["name"] for line in lines}
    with options.out.open("a", encoding="utf-8") as file:
        for case in cases(options):
            if case.name not in done:
                one = run(case, loop=options.loop)
                file.write(json.dumps(one) + "\n")
                file.flush()
                print(one_line(one), flush=True)


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the requested cases, each made when it is needed."""
    kinds = options.kinds.split(",")
    numbers: dict[Any, Sequence[int]] = {
        make_fault: [n for n in range(OF_EACH * len(KINDS)) if KINDS[n % len(KINDS)] in kinds],
        make_clean: range(CLEAN if "clean" in kinds else 0),
        make_missing: range(MISSING if "effect" in kinds else 0),
    }
    for make, own in numbers.items():
        held = [n // len(KINDS) % 2 == 1 if make is make_fault else n % 2 == 1 for n in own]
        chosen = [n for n, back in zip(own, held, strict=True) if back == options.held_back]
        chosen = [n for n in own if n in options.only] if options.only else chosen
        for number in chosen[:: options.every]:
            yield make(number)


def run(case: Case, *, loop: bool) -> dict[str, Any]:
    """Fit a case, close the loop on it, and keep the sentences about its records."""
    problem, resources = make_problem(case.data), Resources(executor="local")
    found: dict[str, Any] = {"name": case.name, "kind": case.kind, "held_back": case.held_back}
    record = "" if case.record < 0 else run_name(case.record, case.data.experiments[case.record])
    begin = time.process_time()
    try:
        fitted = fit(problem, resources=resources)
        found |= {"fit": _told(case, record, fitted.notes), "fit_simulations": fitted.simulated}
        found |= {"fit_seconds": time.process_time() - begin}
        if loop:
            begin = time.process_time()
            closed = close_loop(problem, resources)
            first = closed.message.partition(";")[0]
            found |= {"loop": _told(case, record, (closed.message, *closed.notes))}
            found |= {"first": _told(case, record, (first,))["named"], "verdict": closed.verdict}
            found |= {"effects": [each.equation for each in closed.effects]}
            found |= {"loop_simulations": closed.simulated, "summary": closed.message}
            found |= {"loop_seconds": time.process_time() - begin}
    except ClusterEstError as error:
        found |= {"error": str(error)}
    return found


def _told(case: Case, record: str, sentences: Sequence[str]) -> dict[str, Any]:
    """Return whether a sentence names the fault, and all sentences that claim a fault."""
    claims = [s for s in sentences if ANY.search(s)]
    if case.kind == "evidence":
        aside = [s for s in sentences if SET_ASIDE.search(s)]
        return {"named": not aside, "claims": [*claims, *aside]}
    if not case.kind:
        return {"named": not claims, "claims": claims}
    kinds = {case.kind}
    if case.kind in ("delay", "clock") and len(case.data.system.outputs) == 1:
        kinds = {"delay", "clock"}  # for a single output, they are equivalent
    named = [s for s in claims if record in s and any(re.search(WORDS[kind], s) for kind in kinds)]
    return {"named": bool(named), "claims": claims}


def one_line(one: dict[str, Any]) -> str:
    """Return the result of a case in one line."""
    if "error" in one:
        return f"{one['name']}: {one['error']}"
    said = [
        f"{how} {'right' if one[how]['named'] else 'WRONG'}"
        for how in ("fit", "loop")
        if how in one
    ]
    if "loop" in one:
        said += ["first" if one["first"] else "not first", f"{one['verdict']} {one['effects']}"]
    claims = one.get("loop", one["fit"])["claims"]
    return f"{one['name']}: {', '.join(said)}: {' | '.join(claims) or 'nothing said'}"


def page(results: Sequence[dict[str, Any]]) -> str:
    """Return a table by kind."""
    lines = ["| kind | half | cases | fit | loop | said first | effects claimed | errors |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    keys = [(each["kind"] or each["name"].split()[0], each["held_back"]) for each in results]
    for kind, held in sorted(set(keys), key=lambda key: (SETS.index(key[0]), key[1])):
        own = [one for one, key in zip(results, keys, strict=True) if key == (kind, held)]
        good = [one for one in own if "error" not in one]
        loops = [one for one in good if "loop" in one]
        lines.append(
            f"| {kind} | {'held back' if held else 'open'} | {len(own)} | "
            f"{sum(one['fit']['named'] for one in good)} | "
            f"{sum(one['loop']['named'] for one in loops)} of {len(loops)} | "
            f"{sum(one['first'] for one in loops)} | "
            f"{sum(bool(one['effects']) for one in loops)} | {len(own) - len(good)} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
