"""What a designed experiment tells apart, beside what was expected and what a random one tells.

Cases of the closed-loop benchmark (every `every`th) in which the true effect ends among rivals:
another set of effects is within 10 of the information criterion. The next experiment is designed,
within limits a quarter wider than the inputs have been, simulated from the benchmark's own
equations with noise, and the loop is closed again with it; the same for the median random input
within the same limits. Scores are kept in the file `out`, one a line, and a case that is in it is
not run again: all of them take hours. The last rows have the shares of all cases in the file.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from closed_loop_benchmark.data import make, make_problem
from closed_loop_benchmark.naming import accepted_names, in_words, is_true, normal
from closed_loop_benchmark.scenarios import Scenario, all_scenarios
from scipy.stats import spearmanr

import cluster_est as ce
from benches import Row
from benches.design_precision import limits_of, measured
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.experiment_design.design import design
from cluster_est.experiment_design.design_result import DesignResult
from cluster_est.experiment_design.design_sentences import TOLD_APART
from cluster_est.experiment_design.input_search import ranked
from cluster_est.experiment_design.models import CandidateModel, fit_candidates
from cluster_est.experiment_design.predicted_outputs import DesignQueue
from cluster_est.experiment_design.request import models_of
from cluster_est.problem.problem import Problem
from cluster_est.running.environment import RunEnvironment
from workers.messages import Experiment

OPTIONS = {"every": 1, "processes": 2, "out": "design.jsonl"}
NEAR = 10.0
"""Difference of the criterion within which models are rivals: less than very strong evidence."""
KINDS = ("single", "coloured", "textbook")
QUESTIONS = (
    "truth named alone",
    "the same but for rivals that it would not tell, as the design said",
    "the same, and for models with more coefficients",
)


@dataclass(frozen=True)
class RivalsScore:
    """One case: who was near before, after the designed experiment, and after a random one.

    Attributes
    ----------
    before, designed, random
        The names of the models within `NEAR` of the best.
    told, random_told
        Whether the truth is the only one of them; whether all others are such that the design said
        that it would not tell them apart; whether all others are such, or have more coefficients,
        so that they may hold the truth as a special case.
    predicted, came
        Evidence for the true model against each rival.
    """

    name: str
    before: list[str] = field(default_factory=list)
    designed: list[str] = field(default_factory=list)
    random: list[str] = field(default_factory=list)
    told: tuple[bool, ...] = ()
    random_told: tuple[bool, ...] = ()
    predicted: list[float] = field(default_factory=list)
    came: list[float] = field(default_factory=list)
    error: str = ""


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each case that is run now, and rows about all that are in the file."""
    path = Path(options.out)
    done = {score.name for score in read(path)}
    names = [case.name for case in all_scenarios() if case.kind in KINDS and case.effects]
    names = [name for name in names[:: options.every] if name not in done]
    context = multiprocessing.get_context("spawn")
    with (
        context.Pool(options.processes, maxtasksperchild=5) as pool,
        path.open("a", encoding="utf-8") as file,
    ):
        for score in pool.imap_unordered(rivals_of, names):
            file.write(json.dumps(asdict(score)) + "\n")
            file.flush()
            error = score.error.splitlines()[-1] if score.error else ""
            yield {"case": score.name, "near before": len(score.before),
                   "designed": len(score.designed), "random": len(score.random),
                   "error": error}  # fmt: skip
    yield from summary(read(path))


def read(path: Path) -> list[RivalsScore]:
    """The scores that a file holds."""
    if not path.is_file():
        return []
    return [RivalsScore(**json.loads(line)) for line in path.read_text().splitlines()]


def rivals_of(name: str) -> RivalsScore:
    """Close the loop, design, measure, and close it again."""
    try:
        return _rivals_of(next(case for case in all_scenarios() if case.name == name))
    except Exception:  # one bad case must not end the others
        return RivalsScore(name, error=traceback.format_exc())


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
    after, random_after = again(problem, designed), again(problem, drawn)
    same = {
        row.rival for row in found.evidence if row.true_model in truth and row.evidence < TOLD_APART
    }
    predicted, came = evidence(loop, found, designed, truth[0])
    return RivalsScore(
        case.name,
        before,
        near(after),
        near(random_after),
        told_apart(after, case, same),
        told_apart(random_after, case, same),
        predicted,
        came,
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


def told_apart(loop: LoopResult, case: Scenario, same: set[str]) -> tuple[bool, ...]:
    """Whether the true model is near, and nothing else; but `same`; but those and larger ones."""
    names = near(loop)
    true = [name for name in names if is_true_name(name, case)]
    sizes = {model.name: len(model.values) for model in loop.competing}
    least = min((size for name, size in sizes.items() if is_true_name(name, case)), default=np.inf)
    larger = {name for name, size in sizes.items() if size > least}
    return tuple(
        bool(true) and all(name in true or name in allowed for name in names)
        for allowed in (set(), same, same | larger)
    )


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


def summary(scores: Sequence[RivalsScore]) -> Iterator[Row]:
    """The shares, and how predicted evidence agrees with what came."""
    rivals = [score for score in scores if score.designed]
    yield {"cases": len(scores), "failed": sum(bool(score.error) for score in scores),
           "with the truth among rivals": len(rivals)}  # fmt: skip
    for i, question in enumerate(QUESTIONS):
        yield {"afterwards": question, "of": len(rivals),
               "designed": sum(score.told[i] for score in rivals),
               "random": sum(score.random_told[i] for score in rivals)}  # fmt: skip
    predicted = np.array([p for score in rivals for p in score.predicted])
    came = np.array([c for score in rivals for c in score.came])
    told = predicted >= TOLD_APART
    if told.sum() > 2:
        size = np.log10(np.maximum(predicted[told], 0.1)), np.log10(np.maximum(came[told], 0.1))
        yield {
            "pairs told apart": int(told.sum()),
            "correlation of logarithms": float(np.corrcoef(*size)[0, 1]),
            "of all ranks": float(spearmanr(predicted, came)[0]),
            "came over predicted, median": float(np.median(came[told] / predicted[told])),
        }
