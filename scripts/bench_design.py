"""What a designed experiment tells, beside what was expected of it and what a random one tells.

    python scripts/bench_design.py rivals --out design.jsonl [--every 2] [--processes 2]
    python scripts/bench_design.py rivals --out design.jsonl --summary
    python scripts/bench_design.py precision

`rivals` takes cases of the closed-loop benchmark in which the true effect ends among rivals:
another set of effects is within 10 of the information criterion. The next experiment is designed,
within limits a quarter wider than the inputs have been, simulated from the benchmark's own
equations with noise, and the loop is closed again with it; the same for the median random input
within the same limits. `precision` compares the standard errors of D-optimal inputs with those that
were predicted, and with those of a multisine of equal power.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from closed_loop_benchmark.data import Data, draw_noise, make
from closed_loop_benchmark.likely import accepted_names, is_true
from closed_loop_benchmark.naming import normal
from closed_loop_benchmark.problem import make_problem
from closed_loop_benchmark.scenarios import Scenario, all_scenarios
from closed_loop_benchmark.scoring import in_words
from closed_loop_benchmark.system import Run
from closed_loop_benchmark.truth import simulate
from scipy.stats import spearmanr

import cluster_est as ce
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.experiment_design.design import design
from cluster_est.experiment_design.design_result import DesignResult
from cluster_est.experiment_design.design_sentences import TOLD_APART
from cluster_est.experiment_design.input_search import ranked
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.models import CandidateModel, fit_candidates
from cluster_est.experiment_design.predicted_outputs import DesignQueue
from cluster_est.experiment_design.request import DesignSettings, models_of
from cluster_est.problem.problem import Problem
from cluster_est.running.environment import RunEnvironment
from workers.messages import Experiment

NEAR = 10.0
"""Difference of the criterion within which models are rivals: less than very strong evidence."""
WIDER = 0.25
CANDIDATES = 120
PRECISION = ("mass_spring_damper", "dc_motor", "thermal_two_node")
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
KINDS = ("single", "coloured", "textbook")


@dataclass(frozen=True)
class RivalsScore:
    """One case: who was near before, after the designed experiment, and after a random one.

    `before`, `designed` and `random` hold the names of the models within `NEAR` of the best;
    `alone` says whether the truth is the only one of them, `told` whether all others are such that
    the design said that it would not tell them apart, `simplest` whether all others are such, or
    have more coefficients, so that they may hold the truth as a special case. `predicted` and
    `came` are evidence for the true model against each rival.
    """

    name: str
    before: list[str] = field(default_factory=list)
    designed: list[str] = field(default_factory=list)
    random: list[str] = field(default_factory=list)
    alone: bool = False
    told: bool = False
    simplest: bool = False
    random_alone: bool = False
    random_told: bool = False
    random_simplest: bool = False
    predicted: list[float] = field(default_factory=list)
    came: list[float] = field(default_factory=list)
    seconds: float = 0.0
    simulations: int = 0
    error: str = ""


def main() -> None:
    """Do what the arguments ask for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("rivals", "precision"))
    parser.add_argument("--out", type=Path, default=Path("design.jsonl"))
    parser.add_argument("--names", type=Path, help="file with a case's name a line; default: all")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--summary", action="store_true", help="of what is in the file")
    options = parser.parse_args()
    if options.what == "precision":
        precision()
    elif options.summary:
        summarise(read(options.out))
    else:
        run(options)


def run(options: argparse.Namespace) -> None:
    """Run the cases that are not in the file yet."""
    wanted = set(options.names.read_text().splitlines()) if options.names else None
    done = {score.name for score in read(options.out)}
    cases = [
        case
        for case in all_scenarios()
        if case.kind in KINDS and case.effects and (wanted is None or case.name in wanted)
    ][:: options.every]
    cases = [case for case in cases if case.name not in done]
    print(f"{len(cases)} cases to run", flush=True)
    for variable in ONE_THREAD:  # of the processes that are started now
        os.environ.setdefault(variable, "1")
    with (
        multiprocessing.get_context("spawn").Pool(options.processes, maxtasksperchild=5) as pool,
        options.out.open("a", encoding="utf-8") as file,
    ):
        for score in pool.imap_unordered(rivals_of, [case.name for case in cases]):
            file.write(json.dumps(asdict(score)) + "\n")
            file.flush()
            print(one_line(score), flush=True)
    summarise(read(options.out))


def read(path: Path) -> list[RivalsScore]:
    """The scores that a file holds."""
    if not path.is_file():
        return []
    return [RivalsScore(**json.loads(line)) for line in path.read_text().splitlines()]


def rivals_of(name: str) -> RivalsScore:
    """Close the loop, design, measure, and close it again."""
    begin = time.monotonic()
    try:
        case = next(case for case in all_scenarios() if case.name == name)
        score = _rivals_of(case)
    except Exception:
        score = RivalsScore(name, error=traceback.format_exc())
    return replace(score, seconds=time.monotonic() - begin)


def _rivals_of(case: Scenario) -> RivalsScore:
    data = make(case)
    problem = make_problem(data)
    loop = ce.close_loop(problem)
    before = near(loop)
    truth = [name for name in before if is_true_name(name, case)]
    if not truth or len(truth) == len(before):
        return RivalsScore(case.name, before)
    found = design(loop, limits_of(data, problem))
    random = ranked([c for c in found.candidates if c.candidate.origin == "random"])
    designed = measured(data, found.experiment, 1)
    drawn = measured(data, random[len(random) // 2].candidate.experiment, 2)
    loops = [again(problem, each) for each in (designed, drawn)]
    after, random_after = map(near, loops)
    same = {
        row.rival for row in found.evidence if row.true_model in truth and row.evidence < TOLD_APART
    }
    predicted, came = evidence(loop, found, designed, truth[0])
    return RivalsScore(
        case.name,
        before,
        after,
        random_after,
        alone=only(after, case, set()),
        told=only(after, case, same),
        simplest=only(after, case, same | larger(loops[0], case)),
        random_alone=only(random_after, case, set()),
        random_told=only(random_after, case, same),
        random_simplest=only(random_after, case, same | larger(loops[1], case)),
        predicted=predicted,
        came=came,
        simulations=found.simulated,
    )


def near(loop: LoopResult) -> list[str]:
    """Names of the models within `NEAR` of the best, the one that was found first."""
    if not loop.competing:
        return [str(loop.verdict)]
    best = min(model.criterion for model in loop.competing)
    return [model.name for model in loop.competing if model.criterion <= best + NEAR]


def is_true_name(name: str, case: Scenario) -> bool:
    """Whether a set of effects is the true one, by its own names or algebraic aliases."""
    return is_true([_in_words(label) for label in name.split(" + ")], accepted_names()[case.name])


def _in_words(label: str) -> str:
    """The benchmark's words for a label such as "coulomb at der(v) of w"."""
    form, _, rest = label.partition(" at ")
    site, _, variables = rest.partition(" of ")
    form, _, inner = form.partition("(")
    own = [each.strip() for each in (inner.rstrip(")") or variables).split(",") if each.strip()]
    return in_words(normal(form, site, own))


def only(names: Sequence[str], case: Scenario, same: set[str]) -> bool:
    """Whether the true model is near, and nothing else but it and `same`."""
    true = [name for name in names if is_true_name(name, case)]
    return bool(true) and all(name in true or name in same for name in names)


def larger(loop: LoopResult, case: Scenario) -> set[str]:
    """Names of the models that have more coefficients than the true one."""
    sizes = {model.name: len(model.values) for model in loop.competing}
    true = [size for name, size in sizes.items() if is_true_name(name, case)]
    return {name for name, size in sizes.items() if true and size > min(true)}


def limits_of(data: Data, problem: Problem) -> ExperimentLimits:
    """The inputs a quarter wider than they have been; as long and as dense as a record."""
    inputs = {}
    for place, name in enumerate(data.system.inputs):
        values = np.concatenate([run.inputs[:, place] for run in data.experiments])
        low, high = float(values.min()), float(values.max())
        room = WIDER * (high - low)
        lowest = low - room if low < 0.0 else max(low - room, 0.0)
        inputs[name] = InputLimits(lower=lowest, upper=high + room)
    times = problem.experiments[0].outputs[0].times
    step = float(times[1] - times[0])
    duration = float(times[-1] - times[0])
    return ExperimentLimits(inputs=inputs, duration=(duration, duration), sample_time=step)


def measured(data: Data, experiment: Experiment, stream: int) -> Experiment:
    """The experiment as it would be measured: from the benchmark's own equations, with noise."""
    first = data.experiments[0]
    known = {given.variable: given for given in experiment.inputs}
    inputs = np.column_stack([known[name].values for name in data.system.inputs])
    run = Run("designed", "train", inputs, dict(first.true_starts), first.signals)
    (true,) = simulate(data.system, [run], data.scenario.effects, [])
    random = np.random.default_rng([data.scenario.seed, stream])
    noisy = true + data.sigma * draw_noise(true.shape, data.scenario.noise, random)
    outputs = tuple(
        ce.Output(name, data.times, np.ascontiguousarray(column), float(sigma))
        for name, column, sigma in zip(data.system.outputs, noisy.T, data.sigma, strict=True)
    )
    return replace(experiment, id=f"next {stream}", outputs=outputs, bounds=())


def again(problem: Problem, experiment: Experiment) -> LoopResult:
    """Close the loop with one experiment more."""
    return ce.close_loop(replace(problem, experiments=(*problem.experiments, experiment)))


def evidence(
    loop: LoopResult, found: DesignResult, experiment: Experiment, true: str
) -> tuple[list[float], list[float]]:
    """The evidence for the true model that was predicted, and what came, for each rival."""
    models = models_of(loop)
    before = squares(models)
    more = [
        replace(
            model,
            problem=replace(model.problem, experiments=(*model.problem.experiments, experiment)),
        )
        for model in models
    ]
    after = squares(more)
    gained = {name: after[name] - before[name] for name in before}
    predicted, came = [], []
    for row in found.evidence:
        if row.true_model == true:
            predicted.append(row.evidence)
            came.append(0.5 * (gained[row.rival] - gained[true]))
    return predicted, came


def squares(models: Sequence[CandidateModel]) -> dict[str, float]:
    """Sum of squares of each model, fitted, in variances of the noise."""
    queue = DesignQueue(RunEnvironment(), models[0].problem)
    fitted, _ = queue.use(
        models[0].problem.experiments, "fitting", lambda runner: fit_candidates(runner, models, 0)
    )
    return {each.model.name: each.squares for each in fitted}


def one_line(score: RivalsScore) -> str:
    """What a case came to."""
    if score.error:
        return f"{score.name}: {score.error.splitlines()[-1]}"
    if not score.designed:
        return f"{score.name}: no rivals ({', '.join(score.before)})"
    return (
        f"{score.name}: {len(score.before)} near, designed {len(score.designed)} (alone "
        f"{score.alone}, but for the same {score.told}), random {len(score.random)} (alone "
        f"{score.random_alone}, {score.random_told}), {score.seconds:.0f} s"
    )


def summarise(scores: Sequence[RivalsScore]) -> None:
    """Print the shares, and how predicted evidence agrees with what came."""
    failed = [score for score in scores if score.error]
    rivals = [score for score in scores if score.designed]
    count = max(len(rivals), 1)
    print(f"{len(scores)} cases, {len(failed)} failed, {len(rivals)} with the truth among rivals")
    for key, what in (
        ("alone", "truth named alone after the designed experiment"),
        ("told", "the same but for rivals that it would not tell, as the design said"),
        ("simplest", "the same, and for models with more coefficients"),
        ("random_alone", "truth named alone after a random experiment"),
        ("random_told", "the same but for those rivals"),
        ("random_simplest", "the same, and for models with more coefficients"),
    ):
        right = sum(getattr(score, key) for score in rivals)
        print(f"{what}: {right} of {len(rivals)} ({100.0 * right / count:.1f} %)")
    predicted = np.array([p for score in rivals for p in score.predicted])
    came = np.array([c for score in rivals for c in score.came])
    told = predicted >= TOLD_APART
    if told.sum() > 2:
        size = np.log10(np.maximum(predicted[told], 0.1)), np.log10(np.maximum(came[told], 0.1))
        print(
            f"predicted evidence and what came, {int(told.sum())} pairs above {TOLD_APART:g}: "
            f"correlation of logarithms {np.corrcoef(*size)[0, 1]:.2f}, of ranks "
            f"{spearmanr(predicted, came)[0]:.2f} (all {len(came)}); median of what came over "
            f"predicted {np.median(came[told] / predicted[told]):.2f}"
        )


def precision() -> None:
    """Compare the standard errors of D-optimal inputs with predicted ones and a multisine's.

    So far there is one short record, so that the new experiment decides; the input alone is
    limited, as its power is what is compared.
    """
    for name in PRECISION:
        case = next(c for c in all_scenarios() if c.system == name and c.kind == "clean")
        data = make(replace(case, noise=replace(case.noise, correlation=0.0)))
        problem = make_problem(data)
        alone = replace(problem, experiments=(shortened(problem.experiments[0]),))
        result = ce.fit(alone, method=ce.LeastSquares(max_iterations=60))
        limits = limits_of(data, problem)
        signals = dict.fromkeys(data.system.outputs, SignalLimits(lower=-1e6, upper=1e6))
        found = design(
            result,
            limits.changed(signals=signals),
            settings=DesignSettings(criterion="d", candidates=CANDIDATES),
        )
        came = errors_with(alone, measured(data, found.experiment, 1))
        ratios = [came[row.label] / row.std_error_after for row in found.precision]
        over = {}
        for kind in ("power", "limits"):
            sines = []
            for seed in range(5):
                wave = multisine(found.experiment, limits, np.random.default_rng(seed), kind)
                own = errors_with(alone, measured(data, wave, 3 + seed))
                sines.append([came[row.label] / own[row.label] for row in found.precision])
            over[kind] = np.exp(np.mean(np.log(np.median(np.array(sines), axis=0))))
        print(
            f"{name}: {found.summary}; what came over what was expected "
            f"{min(ratios):.3f} to {max(ratios):.3f}; standard errors over those of a multisine, "
            f"geometric means: of equal power {over['power']:.2f}, within the same limits "
            f"{over['limits']:.2f}",
            flush=True,
        )


def shortened(experiment: Experiment) -> Experiment:
    """The first fifth of a record."""
    stop = experiment.start + 0.2 * (experiment.stop - experiment.start)
    outputs = []
    for output in experiment.outputs:
        kept = output.times <= stop
        outputs.append(replace(output, times=output.times[kept], values=output.values[kept]))
    return replace(experiment, stop=stop, outputs=tuple(outputs))


def errors_with(problem: Problem, experiment: Experiment) -> dict[str, float]:
    """The standard errors of a fit with one experiment more, by label."""
    both = replace(problem, experiments=(*problem.experiments, experiment))
    result = ce.fit(both, method=ce.LeastSquares(max_iterations=60))
    return {estimate.label: estimate.std_error for estimate in result.estimates}


def multisine(
    experiment: Experiment, limits: ExperimentLimits, random: np.random.Generator, kind: str
) -> Experiment:
    """The same experiment, driven by a multisine of equal power, or one as large as limits allow.

    A flat spectrum of all harmonics of the record up to an eighth of the rate of the samples.
    """
    inputs = []
    for given in experiment.inputs:
        times = given.times - given.times[0]
        count = int(times[-1] / (8.0 * (times[1] - times[0])))
        frequencies = np.arange(1, count + 1) / times[-1]
        phases = random.uniform(0.0, 2.0 * np.pi, count)
        wave = np.sin(2.0 * np.pi * np.outer(times, frequencies) + phases).sum(axis=1)
        own = limits.inputs[given.variable]
        if kind == "power":
            values = given.values.mean() + (wave - wave.mean()) * given.values.std() / wave.std()
        else:
            values = own.lower + (own.upper - own.lower) * (wave - wave.min()) / np.ptp(wave)
        inputs.append(replace(given, values=values))
    return replace(experiment, inputs=tuple(inputs))


if __name__ == "__main__":
    main()
