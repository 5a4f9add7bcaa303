"""Comparison of the result of a closed loop with the truth: one record for each case."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from closed_loop_benchmark.data import Data, run_of
from closed_loop_benchmark.effect import Name
from closed_loop_benchmark.naming import Match, compare, in_words, label_in_words, normal
from closed_loop_benchmark.oracle import Oracle, count_free, refit, translate
from cluster_est import Problem
from cluster_est.closed_loop.findings.effects import NamedEffect, Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.result import Result

SAME_MODEL = 0.1
"""Two structures are the same model on the data if their outputs differ by less, in sigmas."""

REFERENCES = {"at", "ref"}
"""Coefficients that are a free choice if an effect has a strength."""
STRENGTHS = {"k", "back"}

REMARKABLE = (Verdict.FOUND, Verdict.PARTIAL, Verdict.UNEXPLAINED)


@dataclass(frozen=True)
class Score:
    """One scored case. Missing values are NaN; a list has an entry for each true effect.

    Attributes
    ----------
    name, system, kind, split, size, correlation
        The case; `correlation` is that of its noise.
    true, named
        Names, in words; each true effect by its canonical name.
    verdict, detected
        The verdict, and whether it says that something is missing.
    exact, alias, form_and_site, tied, plausible, site, any_site, place
        See `closed_loop_benchmark.naming.Match`.
    numerical
        Whether the complete structure is the same model on the data, whatever its name: it has no
        more effects than the truth, and refitted to the outputs without noise, its error is less
        than `SAME_MODEL`.
    distance, distance_without
        Error of the structure, and of the declared model: rms over the training runs, in sigmas.
        For a weak effect, the second is hardly above `SAME_MODEL`.
    coefficients, true_coefficients
        Numbers of free coefficients of the named and of the true structure. With more coefficients,
        one form can include another as a special case.
    superfluous
        Effects beyond one for each true effect.
    likelihood_ratio
        Sum of squares of the declared model minus that of the true structure refitted.
    has_oracle
        Whether the library can express the true structure; otherwise the likelihood ratio and
        `oracle` are those of the truth itself.
    before, after, oracle, floor
        Held-out error of the declared model, of the model found, of the true structure refitted and
        of the truth: rms in sigmas.
    train_before, train_after
        Training error of the first two.
    parameters_before, parameters_after
        Root mean square of the logarithmic error of the declared parameters.
    covered, intervals
        Number of 95 % intervals of coefficients that contain the truth, and total number; see
        `coverage`.
    simulations, seconds, failures
        The cost.
    structures
        For every refitted set of effects, in the order of the rounds: names, in words; criterion
        relative to the declared model; and whether it was refitted to convergence.
    likely
        The sets with 90 % of the probability, if known: names, in words.
    claims
        For each named effect or lead, whether it is claimed, right in place and law, and right in
        place; and its evidence (see `ClaimEvidence`).
    active, spans
        The active parts of the search, and the simulations before and after each call of one; None
        if not recorded. See `closed_loop_benchmark.activity`.
    error
        The traceback of an error, or "".
    """

    name: str
    system: str
    kind: str
    split: str
    size: float
    correlation: float
    true: list[str]
    named: list[str] | None = None
    verdict: str = ""
    detected: bool = False
    exact: list[bool] | None = None
    alias: list[bool] | None = None
    form_and_site: list[bool] | None = None
    tied: list[bool] | None = None
    plausible: list[bool] | None = None
    site: list[bool] | None = None
    any_site: list[bool] | None = None
    place: list[bool] | None = None
    numerical: bool = False
    distance: float = np.nan
    distance_without: float = np.nan
    coefficients: int = 0
    true_coefficients: int = 0
    superfluous: int = 0
    likelihood_ratio: float = np.nan
    has_oracle: bool = False
    before: float = np.nan
    after: float = np.nan
    oracle: float = np.nan
    floor: float = np.nan
    train_before: float = np.nan
    train_after: float = np.nan
    parameters_before: float = np.nan
    parameters_after: float = np.nan
    covered: int = 0
    intervals: int = 0
    simulations: float = np.nan
    seconds: float = np.nan
    failures: int = 0
    structures: list[tuple[list[str], float, bool]] | None = None
    likely: list[list[str]] | None = None
    claims: list[dict[str, Any]] | None = None
    active: list[str] | None = None
    spans: list[tuple[str, float, float]] | None = None
    error: str = ""

    def to_json(self) -> str:
        """Return the record as one line."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(line: str) -> Score:
        """Read a record written by `to_json`."""
        return Score(**json.loads(line))


def blank(data: Data, error: str = "") -> Score:
    """Return the record of a case without a result."""
    case = data.scenario
    return Score(
        name=case.name,
        system=case.system,
        kind=case.kind,
        split=case.split,
        size=case.size,
        correlation=case.noise.correlation,
        true=[in_words(normal(n[0].form, n[0].site, (n[0].variable,))) for n in case.accepted],
        error=error,
    )


def score(data: Data, result: LoopResult, oracle: Oracle) -> Score:
    """Compare a result with the truth.

    Parameters
    ----------
    data
        The case.
    result
        Result of the method.
    oracle
        Results of the true structure.

    Returns
    -------
    Score
        All data of the tables.
    """
    found = {
        **_naming(data, result),
        **_distances(data, result),
        **_errors(data, result, oracle),
    }
    covered, intervals = coverage(data, result)
    return replace(
        blank(data),
        claims=_claims(data, result, same=bool(found.get("numerical"))),
        covered=covered,
        intervals=intervals,
        verdict=str(result.verdict),
        detected=bool(result.effects) or result.verdict in REMARKABLE,
        coefficients=sum(count_free(e.effect) for e in result.effects),
        true_coefficients=oracle.coefficients,
        has_oracle=oracle.fit is not None,
        simulations=float(result.simulations),
        seconds=float(result.seconds),
        failures=result.failures,
        structures=[
            ([label_in_words(label) for label in s.effects], s.criterion, s.converged)
            for s in result.structures
            if s.effects
        ],
        likely=[[label_in_words(label) for label in s.effects] for s in result.likely],
        **found,
    )


def _naming(data: Data, result: LoopResult) -> dict[str, Any]:
    """Return the comparison of names, with an entry for each true effect."""
    accepted = data.scenario.accepted
    named = [normal(e.form, e.site, e.variables) for e in result.effects]
    others = list(_alternatives(result.effects))
    matches = [asdict(compare(names, named, others)) for names in accepted]
    inside = data.scenario.kind != "outside"  # otherwise no name is right
    marks = {f.name: [match[f.name] and inside for match in matches] for f in fields(Match)}
    return {
        **marks,
        "named": [in_words(name) for name in named],
        "superfluous": max(len(named) - len(accepted), 0),
    }


def _claims(data: Data, result: LoopResult, *, same: bool) -> list[dict[str, Any]]:
    """Return the evidence for each claimed effect or lead, and whether it is right.

    It is right if it has a name of a true effect, or if the complete structure is the `same` model.
    A free curve is right at the place of an effect that the library cannot express.
    """
    accepted = [
        normal(n.form, n.site, (n.variable,)) for own in data.scenario.accepted for n in own
    ]
    places = {(name.site, name.variable) for name in accepted}
    claims = []
    for effect in (*result.effects, *result.rejected):
        if effect.claim is None:
            continue
        name = normal(effect.form, effect.site, effect.variables)
        place = (name.site, name.variable) in places
        kind = name in accepted or (
            effect.claim.evidence.free and place and data.scenario.kind == "outside"
        )
        marks = {
            "claimed": effect in result.effects,
            "right": same or kind,
            "place": same or place,
        }
        claims.append({"effect": in_words(name), **marks, **asdict(effect.claim.evidence)})
    return claims


def _distances(data: Data, result: LoopResult) -> dict[str, Any]:
    """Return the distance of the result from the truth, if it has no more effects."""
    if not 0 < len(result.effects) <= len(data.scenario.accepted):
        return {}
    distance = missed(data, result.after)
    return {
        "numerical": distance < SAME_MODEL,
        "distance": distance,
        "distance_without": missed(data, result.before),
    }


def _errors(data: Data, result: LoopResult, oracle: Oracle) -> dict[str, Any]:
    """Return the errors before and after, and the smallest possible errors."""
    return {
        "likelihood_ratio": _sum_of_squares(result) - oracle.best.sse,
        "before": result.rms("test", "before"),
        "after": result.rms("test", "after"),
        "oracle": oracle.best.test,
        "floor": oracle.truth.test,
        "train_before": result.rms("train", "before"),
        "train_after": result.rms("train", "after"),
        "parameters_before": _parameter_error(data, result.before.x),
        "parameters_after": _parameter_error(data, result.after.x),
    }


def missed(data: Data, fitted: Result) -> float:
    """Refit a structure to the true outputs, and return its error."""
    return refit(_without_noise(data, fitted.problem), fitted.x, held_out=False).train


def _without_noise(data: Data, problem: Problem) -> Problem:
    """Replace the measured outputs, including outliers, by the true outputs."""
    clean = []
    for run in problem.experiments:
        columns = zip(run.outputs, run_of(data, run.id).true_outputs.T, strict=True)
        outputs = []
        for output, column in columns:
            first, last = output.times[[0, -1]]
            inside = (data.times >= first) & (data.times <= last)
            outputs.append(replace(output, times=data.times[inside], values=column[inside]))
        clean.append(replace(run, outputs=tuple(outputs)))
    return replace(problem, experiments=tuple(clean))


def _alternatives(effects: Sequence[NamedEffect]) -> Iterable[tuple[Name, float]]:
    for effect in effects:
        for other in effect.alternatives:
            yield normal(other.form, other.site, other.variables), other.criterion


def _sum_of_squares(result: LoopResult) -> float:
    """Return the sum of squares of the declared model on the training runs."""
    rows = [e for e in result.errors if e.role == "train"]
    return float(sum(e.samples * e.normalised_before**2 for e in rows))


def _parameter_error(data: Data, found: dict[str, float]) -> float:
    logs = [np.log(found[name] / true) for name, true in data.true_parameters.items()]
    return float(np.sqrt(np.mean(np.square(logs))))


def coverage(data: Data, result: LoopResult) -> tuple[int, int]:
    """Return the number of 95 % intervals that contain the truth, and the total number.

    Only correctly named effects count; for hidden stores, the form of the start is ignored.
    Variations of parameters are omitted, because their strength depends on the parameter's value at
    the reference point. Strengths at a chosen reference are omitted too. Held coefficients and
    coefficients at a bound have no interval.
    """
    held = [low <= true <= high for true, low, high in _intervals(data, result)]
    return sum(held), len(held)


def _intervals(data: Data, result: LoopResult) -> Iterator[tuple[float, float, float]]:
    for number, effect in enumerate(data.scenario.effects):
        if effect.constants:
            yield from _of_constants(data, result, number)
            continue
        if effect.kind == "parameter":
            continue
        try:
            added, values = translate(effect, number)
        except KeyError:  # the library lacks the form
            continue
        called = normal(added.form, added.site, added.variables)
        for named in result.effects:
            if normal(named.form, named.site, named.variables) == called:
                yield from _of_one(named, values)


def _of_constants(
    data: Data, result: LoopResult, number: int
) -> Iterator[tuple[float, float, float]]:
    """Yield the intervals of an effect that is given with the library's coefficients."""
    effect, first = data.scenario.effects[number], data.scenario.accepted[number][0]
    values = dict(effect.constants)
    if REFERENCES & {*values}:
        values = {name: value for name, value in values.items() if name not in STRENGTHS}
    place = normal(first.form, first.site, (first.variable,))
    for named in result.effects:
        called = normal(named.form, named.site, named.variables)
        same = _without_start(called.form) == _without_start(effect.form)
        if same and (called.site, called.variable) == (place.site, place.variable):
            yield from _of_one(named, values)


def _without_start(form: str) -> str:
    return form.partition("_from_")[0]


def _of_one(named: NamedEffect, values: dict[str, float]) -> Iterator[tuple[float, float, float]]:
    for estimate in named.coefficients:
        low, high = _bounds(estimate)
        name = estimate.label.rpartition(".")[2]
        if name in values and math.isfinite(low) and math.isfinite(high) and low < high:
            yield values[name], low, high


def _bounds(estimate: Estimate) -> tuple[float, float]:
    return (math.nan, math.nan) if estimate.at_bound else (estimate.lower95, estimate.upper95)
