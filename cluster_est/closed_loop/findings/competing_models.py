"""The sets of effects that the data allow: their probabilities, rival models, and costs.

A set is judged by its fit, and by how often it is the best set in resamplings of the experiments.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cluster_est.closed_loop.findings.alternatives import are_one_law
from cluster_est.closed_loop.findings.effects import effect_block
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.gates import SELECTION
from cluster_est.closed_loop.selection.rounds import ComparedStructure, SelectionResult
from cluster_est.problem.display import in_a_row, percent, plain_number
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.statistics.choice_shares import LinearFit, choice_shares
from workers.effects.forms import FORMS
from workers.messages import Effect, IntArray

SHARE = 0.9
"""Sum of the probabilities of the likely sets."""
CRITERION_SCALE = 8.0
"""Differences of the criterion are divided by this number, because the criterion assumes that
models are exact and refits complete. Benchmark: without the division, sets with a total probability
of 98 % contained the truth in 91 % of 260 cases, and claims with more than 99 % were right in 92 %
of 127 cases. With it, these shares are 95 %, and 99 % of 96 cases."""
MOST_NAMED_SETS = 5
"""Largest number of sets in a sentence."""
DECLARED = "no effect"


def choice_price(found: SelectionResult) -> float:
    """Return the penalty for the choice of an effect among all candidates, in -2 log likelihood."""
    return float(SELECTION.choice_price * np.log(found.steps[0].screening.count))


def with_probabilities(
    path: Sequence[ComparedStructure],
    choice: float,
    same: Collection[frozenset[str]] = (),
) -> tuple[ComparedStructure, ...]:
    """Give each set of effects its probability among all that were compared.

    With a criterion B, exp(-B / 2) is proportional to the probability of the data under a model. If
    all models were equally likely beforehand, it is also proportional to the probability of the
    model (A. E. Raftery, Sociol. Methodol. 25 (1995) 111-163, doi:10.2307/271063). Here B includes
    the penalty for the choice of each effect among all candidates, and is divided by
    `CRITERION_SCALE`. This is a fractional likelihood (A. O'Hagan, J. R. Stat. Soc. B 57 (1995)
    99-138, doi:10.1111/j.2517-6161.1995.tb02017.x). Each set counts once, with its best refit, even
    if this refit was stopped early. The declared model is one of the sets.

    Parameters
    ----------
    path
        All refits; a set may have been refitted in several rounds.
    choice
        Penalty for the choice of an effect; see `choice_price`.
    same
        Sets that count together with the found one, because they are the same law; see
        `written_otherwise`. They have no probability of their own.

    Returns
    -------
    tuple[ComparedStructure, ...]
        The same rows, and the declared model as the last row. The best row of each set has its
        probability; the others have NaN.
    """
    declared = ComparedStructure(0, (), 0.0, 0.0, converged=True, accepted=False)
    rows = [*path, declared]
    best = {key: row for key, row in best_rows(rows).items() if key not in same}
    kept = [rows[number] for number in best.values()]
    criteria = np.array([row.criterion + choice * len(row.effects) for row in kept])
    criteria /= CRITERION_SCALE
    weights = np.exp(-0.5 * (criteria - criteria.min()))
    known = dict(zip(best.values(), (weights / np.add.reduce(weights)).tolist(), strict=True))
    return tuple(
        replace(each, probability=known.get(number, np.nan)) for number, each in enumerate(rows)
    )


def best_rows(rows: Sequence[ComparedStructure]) -> dict[frozenset[str], int]:
    """Return the number of the row in which each set of effects has its best refit."""
    best: dict[frozenset[str], int] = {}
    for number, each in enumerate(rows):
        key = frozenset(each.effects)
        if key not in best or each.criterion < rows[best[key]].criterion:
            best[key] = number
    return best


def likely_structures(path: Sequence[ComparedStructure]) -> tuple[ComparedStructure, ...]:
    """Return the fewest sets that together have 90 % of the probability, the likeliest first.

    The set that was added in the end is always among them. Empty if no probabilities are known.
    """
    known = [each for each in path if np.isfinite(each.probability)]
    ranked = sorted(known, key=lambda each: -each.probability)
    held = np.cumsum([each.probability for each in ranked])
    likely = ranked[: int(np.searchsorted(held, SHARE)) + 1]
    added = [frozenset(each.effects) for each in path if each.accepted][-1:]
    likely += [each for each in ranked if frozenset(each.effects) in added and each not in likely]
    return tuple(likely)


def likely_sentence(path: Sequence[ComparedStructure], *, claims: bool = False) -> str:
    """Say which sets of effects are likely; "" if no probabilities are known.

    With `claims`, effects are printed with the probability that each of them is right. That is a
    different probability, and the sentence says so.
    """
    likely = likely_structures(path)
    if not likely:
        return ""
    count = len({frozenset(each.effects) for each in path})
    shares = [percent(each.probability) for each in likely]
    called = [" + ".join(each.effects) or DECLARED for each in likely]
    named = [f"{share} for {name}" for name, share in zip(called, shares, strict=True)]
    if len(named) > MOST_NAMED_SETS:
        named = [
            *named[: MOST_NAMED_SETS - 1],
            f"at most this much for each of {len(named) - MOST_NAMED_SETS + 1} other sets",
        ]
    said = (
        f"{count} sets of effects were compared; with an allowance for model errors, the "
        f"probability is {in_a_row(named)}"
    )
    shared = _shared_families(likely) if len(likely) > 1 else []
    said += f"; each of them has {in_a_row(shared)}" if shared else ""
    return said + ("; " + OTHER_PROBABILITY if claims else "")


OTHER_PROBABILITY = (
    "this compares exactly these sets by their fits; the probability that an effect is right comes "
    "from similar claims, and also counts laws that agree on the data"
)


def _shared_families(likely: Sequence[ComparedStructure]) -> list[str]:
    """Return what all sets have in common, such as "friction at der(v)"; [] if they differ."""
    shared, *others = {tuple(sorted(map(_family, each.effects))) for each in likely}
    return [] if others or not all(shared) else list(shared)


def _family(label: str) -> str:
    """Return the family and the site of a label, "coulomb(w) at der(v)"; "" if not known."""
    called, _, site = label.partition(" at ")
    name = called.partition("(")[0]
    families = {form.family for (_, known), form in FORMS.items() if known == name}
    return f"{families.pop()} at {site}" if len(families) == 1 else ""


MOST_COMPETING = 6
"""Largest number of models that are kept."""
FAR = 50.0
"""Largest difference of the criterion between a rival and the best model. In the probabilities of
structures, it corresponds to odds of about 1 to 20."""


@dataclass(frozen=True)
class CompetingModel:
    """A model that is a likely explanation of the data.

    Attributes
    ----------
    name
        The labels of its effects.
    problem, values
        The problem with these effects, on the experiments of the run; estimates by label.
    criterion
        Bayesian information criterion with the penalty for the choice among the candidates, minus
        that of the model that was found.
    weight
        Probability among the models that are kept.
    added
        The effects that were added, each with its coefficients.
    """

    name: str
    problem: Problem = field(repr=False)
    values: Mapping[str, float] = field(repr=False)
    criterion: float
    weight: float
    added: tuple[tuple[Effect, tuple[Parameter, ...]], ...] = field(repr=False, default=())

    def facts(self) -> dict[str, Any]:
        """Return its entry in run.json, from which the model can be restored."""
        return {
            "name": self.name,
            "criterion": self.criterion,
            "weight": self.weight,
            "config": "".join(effect_block(effect, own) for effect, own in self.added),
            "values": dict(self.values),
        }


def leading_models(fitter: Fitter, found: SelectionResult, most: int) -> list[FittedModel]:
    """Return the models with the best criterion, each set of effects once.

    The model that was found is always the first. Models that are the same law are left out.
    """
    fits = [found.current, found.base, *_refits(found)]
    same = {fit.structure for fit in fits if are_one_law(fitter, found, fit)}
    best: dict[frozenset[str], FittedModel] = {}
    for fit in sorted(fits, key=lambda each: each.criterion(fitter.records)):
        best.setdefault(fit.structure, fit)
    best[found.current.structure] = found.current
    left_out = {found.current.structure, *same}
    others = [fit for key, fit in best.items() if key not in left_out]
    return [found.current, *others[: most - 1]]


def written_otherwise(fitter: Fitter, found: SelectionResult) -> set[frozenset[str]]:
    """Return the sets, by their labels, that are the found law written in other ways."""
    same = (fit for fit in _refits(found) if are_one_law(fitter, found, fit))
    return {frozenset(candidate.label for candidate in fit.added) for fit in same}


def _refits(found: SelectionResult) -> Iterator[FittedModel]:
    """Return the refitted models of a search that are still known."""
    for step in found.steps:
        yield from (each.fitted for each in step.contenders)
    for _, rivals in found.rivals.values():
        yield from (each.fitted for each in rivals)


def competing_models(fitter: Fitter, found: SelectionResult) -> tuple[CompetingModel, ...]:
    """Return the found model, then the rivals that the data do not rule out, the best rival first.

    The weights are probabilities as in `with_probabilities`, among the returned models.
    """
    price = choice_price(found)
    leading = leading_models(fitter, found, 4 * MOST_COMPETING)
    criteria = np.array([fit.criterion(fitter.records) + price * len(fit.added) for fit in leading])
    criteria -= criteria[0]
    order = sorted(range(1, len(leading)), key=lambda i: criteria[i])
    kept = [0, *(i for i in order if criteria[i] < FAR)][:MOST_COMPETING]
    weights = np.exp(-0.5 * (criteria[kept] - criteria[kept].min()) / CRITERION_SCALE)
    weights /= np.add.reduce(weights)
    return tuple(
        _competing(leading[i], float(criteria[i]), weight)
        for i, weight in zip(kept, weights.tolist(), strict=True)
    )


def _competing(fit: FittedModel, criterion: float, weight: float) -> CompetingModel:
    """A fitted model on the run's experiments, with fitted values as starts of its coefficients."""
    values = fit.estimates
    added = []
    for candidate in fit.added:
        own = [p for p in fit.problem.parameters if p.name.startswith(f"{candidate.effect.name}.")]
        begun = tuple(dataclasses.replace(p, start=float(values.get(p.name, p.start))) for p in own)
        added.append((candidate.effect, begun))
    name = " + ".join(candidate.label for candidate in fit.added) or DECLARED
    return CompetingModel(name, fit.problem, values, criterion, weight, tuple(added))


DRAWS = 200
FEWEST_DRAWN = 5
"""Least number of experiments for which whole experiments are drawn. With fewer experiments, parts
of their records are drawn."""
PARTS = 10
LEADING = 12
"""Number of sets of effects that are compared: those with the best criterion."""
MOST_UNKNOWNS = 150
MOST_NAMED_CHOICES = 4
STREAM = 7
"""Number of the fitter's random generator for the resamplings."""


@dataclass(frozen=True)
class ResampledChoices:
    """The share of the resamplings in which each set of effects is the best, by the set's labels.

    `drawn` says what was drawn: experiments, or parts of records.
    """

    drawn: str
    shares: Mapping[tuple[str, ...], float] = field(repr=False)

    @property
    def sentence(self) -> str:
        """Say how often each set is chosen, the most frequent first."""
        ranked = sorted(self.shares.items(), key=lambda known: -known[1])
        named = [
            f"{' + '.join(labels) or DECLARED} in {percent(share)}"
            for labels, share in ranked
            if share > 0.0
        ]
        said = in_a_row(named[:MOST_NAMED_CHOICES])
        return f"in {DRAWS} resamplings of {self.drawn}, the best set of effects was {said}"


def resampled_choices(fitter: Fitter, found: SelectionResult) -> ResampledChoices | None:
    """Resample the training experiments, and choose the best of the leading sets each time.

    Each set is refitted with its linear model, so no simulation is needed. Sets whose refits have
    not converged are left out: far from its minimum, a linear model may promise any fit. None if no
    effect was added, or if a set has too many unknowns.
    """
    if not found.current.added:
        return None
    first, *others = leading_models(fitter, found, LEADING)
    leading = [first, *(fit for fit in others if fit.converged)]
    if max(len(fit.x) for fit in leading) > MOST_UNKNOWNS:
        return None
    choice = choice_price(found)
    fits = [LinearFit(f.residuals, f.jacobian, choice * len(f.added)) for f in leading]
    whole = len(fitter.train) >= FEWEST_DRAWN
    pieces, outputs = _pieces(fitter, whole=whole)
    shares = choice_shares(fits, pieces, outputs, DRAWS, fitter.generator(STREAM))
    drawn = f"the {len(fitter.train)} experiments" if whole else "tenths of the records"
    labels = [tuple(candidate.label for candidate in fit.added) for fit in leading]
    return ResampledChoices(drawn, dict(zip(labels, shares.tolist(), strict=True)))


def with_choices(
    path: Sequence[ComparedStructure], choices: ResampledChoices | None
) -> tuple[ComparedStructure, ...]:
    """Add to each set of effects its share of the resamplings, in the row of its best refit."""
    if choices is None:
        return tuple(path)
    shares = {frozenset(labels): share for labels, share in choices.shares.items()}
    known = {number: shares.get(key, np.nan) for key, number in best_rows(path).items()}
    return tuple(
        replace(each, chosen=known.get(number, np.nan)) for number, each in enumerate(path)
    )


def _pieces(fitter: Fitter, *, whole: bool) -> tuple[IntArray, IntArray]:
    """Return the number of the resampled piece and of the output, for each residual."""
    pieces, outputs = np.zeros(fitter.size, int), np.zeros(fitter.size, int)
    for item in fitter.records.items:
        outputs[item.rows] = item.output
        pieces[item.rows] = item.experiment
        if not whole and len(item.times):
            run = fitter.runs[item.experiment]
            passed = (item.times - run.start) / (run.stop - run.start)
            part = np.clip((PARTS * passed).astype(int), 0, PARTS - 1)
            pieces[item.rows] = PARTS * item.experiment + part
    return np.unique(pieces, return_inverse=True)[1], np.unique(outputs, return_inverse=True)[1]


EXPENSIVE = 5.0
"""Solver steps, relative to those of the declared model, above which a structure is expensive."""


def expensive_structures(path: Sequence[ComparedStructure]) -> tuple[str, ...]:
    """Say whether the last accepted structure that makes simulations expensive does; or nothing.

    A solver with adaptive steps makes more steps if an effect is fast, such as a lag of a
    millisecond in a record of an hour. The steps are counted, not the time, so that the sentence is
    the same on every machine.
    """
    kept = [each for each in path if each.accepted and each.relative_steps > EXPENSIVE]
    if not kept:
        return ()
    named = in_a_row(kept[-1].effects)
    return (
        f"with {named}, a simulation takes {plain_number(kept[-1].relative_steps, 3)} times as "
        "many solver steps as with the declared model, so simulations are slower",
    )
