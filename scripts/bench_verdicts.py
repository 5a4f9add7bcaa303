"""What is said where the data, the declared sigma or the solver are not as they should be.

    python scripts/bench_verdicts.py fits --records results.jsonl --every 4
    python scripts/bench_verdicts.py steps
    python scripts/bench_verdicts.py sigmas
    python scripts/bench_verdicts.py sizes --every 3

All run on cases of the closed loop's benchmark. `fits`: how often a fit of the declared model warns
that something is missing, beside the likelihood ratio of the true structure that `--records` has,
a file of `bench_closed_loop.py`. `steps`: clean cases with a communication step ten times as long
as the sampling interval, or a tolerance of 1e-3; each must be refused or flagged, with no effect.
`sigmas`: declared sigmas ten times too small or too large; each must be named as the likely error.
`sizes`: disturbances that nobody measured; each must be called unexplained, with its size as it is:
what the model leaves of the outputs without their noise, which only the benchmark knows.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from closed_loop_benchmark.data import Data, make
from closed_loop_benchmark.problem import make_problem
from closed_loop_benchmark.scenarios import Scenario, all_scenarios

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.loop import close_loop
from cluster_est.results.facts import residual_sentences

SEEN = 100.0
"""Likelihood ratio above which a fit must warn."""

FLAGS = ("error of", "is never taken")
"""Words of a note on a step or a tolerance: its error beside the noise, or that it has none because
the times of the measurements are closer together."""

NEAR = 0.2
"""Relative error of the size of a disturbance that is still right."""

LONGER, LOOSE, WRONG = 10.0, 1e-3, 10.0
"""A communication step over the sampling interval; a tolerance; a sigma over the true one."""


def main() -> int:
    """Do what the arguments ask for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--records", type=Path, help="of bench_closed_loop.py, for fits")
    parser.add_argument("--every", type=int, default=1, help="of the cases")
    options = parser.parse_args()
    PARTS[options.part](options)
    return 0


def fits(options: argparse.Namespace) -> None:
    """Count the fits that warn."""
    if options.records is None:
        raise SystemExit("--records must be a file of bench_closed_loop.py")
    lines = options.records.read_text(encoding="utf-8").splitlines()
    ratios = {one["name"]: one["likelihood_ratio"] for one in map(json.loads, lines)}
    cases = [case for case in all_scenarios() if case.name in ratios][:: options.every]
    warned = {case.name: _warnings(case) for case in cases}
    parts: dict[str, Callable[[Scenario], bool]] = {
        f"an effect with a likelihood ratio above {SEEN:g}": lambda c: (
            bool(c.effects) and ratios[c.name] > SEEN
        ),
        "nothing missing, white noise": lambda c: c.kind == "clean" and not c.noise.correlation,
        "nothing missing, coloured noise": lambda c: c.kind == "clean" and c.noise.correlation > 0,
        "a disturbance": lambda c: c.kind == "disturbance",
        "nothing missing, outliers": lambda c: c.kind == "outliers" and not c.effects,
    }
    for label, belongs in parts.items():
        own = [case.name for case in cases if belongs(case)]
        said = [name for name in own if warned[name]]
        print(f"{label}: a warning in {len(said)} of {len(own)}")
        rare = said if len(said) < len(own) / 2 else [name for name in own if not warned[name]]
        for name in rare[:20]:
            print(f"    {name}: {' '.join(warned[name]) or 'no warning'}")


def steps(options: argparse.Namespace) -> None:
    """Look for effects where the solver is too coarse."""
    cases = _clean(options.every)
    for label, spoil in (
        (f"communication step {LONGER:g} times as long", _with_long_step),
        (f"rtol {LOOSE:g}", _with_loose_tolerance),
    ):
        flagged, claimed = [], []
        for case in cases:
            try:
                found = close_loop(spoil(make_problem(make(case))))
            except ce.ClusterEstError as error:
                flagged.append(case.name)
                print(f"  {case.name}: refused: {error}", flush=True)
                continue
            said = (found.summary, *found.notes)
            words = [note for note in said if any(word in note for word in FLAGS)]
            flagged += [case.name] * bool(words)
            claimed += [case.name] * bool(found.effects)
            print(f"  {case.name}: {found.verdict}: {found.summary}; {' '.join(words)}", flush=True)
        print(f"{label}: flagged {len(flagged)} of {len(cases)}, an effect in {len(claimed)}")


def sigmas(options: argparse.Namespace) -> None:
    """Look whether a wrong sigma is named."""
    cases = [*_clean(options.every), *_with_one_effect(options.every)]
    for factor in (1.0 / WRONG, WRONG):
        named, changed = 0, 0
        for case in cases:
            problem = make_problem(make(case))
            right, wrong = close_loop(problem), close_loop(_with_sigmas(problem, factor))
            here = "is likely the error" in wrong.summary
            named, changed = named + here, changed + (wrong.summary != right.summary)
            print(f"  {case.name}: {right.verdict} -> {wrong.verdict}: {wrong.summary}", flush=True)
        print(f"sigma times {factor:g}: named as the error in {named} of {len(cases)}, ")
        print(f"    another sentence than with the right one in {changed}")


def sizes(options: argparse.Namespace) -> None:
    """Compare the sizes of disturbances as they are said with what they are."""
    cases = [c for c in all_scenarios() if c.kind == "disturbance"][:: options.every]
    right, unexplained = 0, 0
    for case in cases:
        data = make(case)
        result = close_loop(make_problem(data))
        unexplained += result.verdict is Verdict.UNEXPLAINED and not result.effects
        ratio = _said_over_true(data, result)
        right += abs(ratio - 1.0) <= NEAR
        print(f"  {case.name}: {result.verdict}, said over true size {ratio:.3f}", flush=True)
    print(f"unexplained, no effect: {unexplained} of {len(cases)}; ", end="")
    print(f"size within {NEAR:.0%}: {right} of {len(cases)}")


def _said_over_true(data: Data, result: LoopResult) -> float:
    """The size that is said of the output where it is largest, over what it is; NaN for none."""
    if not result.unexplained:
        return float("nan")
    said = result.unexplained[0]
    column = data.system.outputs.index(said.output)
    left = []
    for run, simulation in zip(data.experiments, result.after.simulations, strict=True):
        seen = simulation.outcome.trajectory
        if run.role == "train" and seen is not None:
            rows = np.searchsorted(seen.times, data.times)
            simulated = seen.values[rows, seen.variables.index(said.output)]
            left.append(run.true_outputs[:, column] - simulated)
    return said.size / float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


PARTS: dict[str, Callable[[argparse.Namespace], None]] = {
    "fits": fits,
    "steps": steps,
    "sigmas": sigmas,
    "sizes": sizes,
}


def _warnings(case: Scenario) -> tuple[str, ...]:
    """What a fit of the declared model says of its residuals."""
    diagnostics = ce.fit(make_problem(make(case))).diagnostics
    return () if diagnostics is None else residual_sentences(diagnostics)


def _clean(every: int) -> list[Scenario]:
    """One or two cases of each system in which nothing is missing, in white noise."""
    cases = [c for c in all_scenarios() if c.kind == "clean" and not c.noise.correlation]
    own: dict[str, list[Scenario]] = {}
    for case in cases:
        own.setdefault(case.system, []).append(case)
    chosen = [case for each in own.values() for case in each[:2]]
    return chosen[: 20 * every : every]


def _with_one_effect(every: int) -> list[Scenario]:
    """The first large effect of each system."""
    found: dict[str, Scenario] = {}
    for case in all_scenarios():
        if case.kind == "single" and case.size == 1.0:
            found.setdefault(case.system, case)
    return list(found.values())[::every]


def _with_long_step(problem: ce.Problem) -> ce.Problem:
    interval = min(_intervals(problem.experiments))
    solver = ce.Solver("fmu", step=LONGER * interval)
    model = replace(problem.model, interface="co_simulation", solver=solver)
    return replace(problem, model=model)


def _with_loose_tolerance(problem: ce.Problem) -> ce.Problem:
    solver = ce.Solver("dormand_prince", rtol=LOOSE)
    model = replace(problem.model, interface="model_exchange", solver=solver)
    return replace(problem, model=model)


def _intervals(experiments: Iterable[ce.Experiment]) -> Sequence[float]:
    return [float(np.median(np.diff(o.times))) for e in experiments for o in e.outputs]


def _with_sigmas(problem: ce.Problem, factor: float) -> ce.Problem:
    """All declared sigmas are so many times the true ones."""
    runs = tuple(
        replace(e, outputs=tuple(replace(o, sigma=factor * o.sigma) for o in e.outputs))
        for e in problem.experiments
    )
    return replace(problem, experiments=runs)


if __name__ == "__main__":
    raise SystemExit(main())
