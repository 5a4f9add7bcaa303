"""A model with the estimates and effects of a run, from which all exports are made.

It is read from the run's folder, or made from a result in memory.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from cluster_est.config.build import build_problem
from cluster_est.config.reader import parse_config
from cluster_est.errors import RunFolderError
from cluster_est.problem.declared_effects import equation_text
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.unknowns import label_of
from cluster_est.problem.variables import coefficient_names
from cluster_est.results.fit_tables import Estimate
from cluster_est.run_folder.logged_simulation import config_base, with_found_effects
from cluster_est.run_folder.run_files import (
    check_has_estimates,
    read_config_text,
    read_facts,
    read_run_table,
)
from workers.effects.definition import EffectDefinition, define_all
from workers.effects.units import UNKNOWN_UNIT, coefficient_units
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Experiment, Value


@dataclass(frozen=True)
class EstimatedValue:
    """One estimated value.

    Attributes
    ----------
    name, unit, value
        The FMU's name of the value, or "EFFECT.COEFFICIENT".
    low, high
        Its 95 % interval; NaN if the data do not determine it, or if it was not estimated.
    lower, upper
        Its bounds; infinite if it has none.
    """

    name: str
    unit: str
    value: float
    low: float = math.nan
    high: float = math.nan
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def interval(self) -> str:
        """Its interval as text, "" if it has none."""
        return "" if math.isnan(self.low) else f"95 %: {self.low:.5g} .. {self.high:.5g}"


@dataclass(frozen=True)
class ReportedError:
    """The root mean square error of an output of an experiment, as reported by the run.

    Attributes
    ----------
    experiment, role, output, unit, samples
        The output, and the number of samples.
    before, after
        Error without and with the effects found; NaN if it cannot be simulated.
    """

    experiment: str
    role: str
    output: str
    unit: str
    samples: int
    before: float
    after: float

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Self:
        """Return the error of a row of errors.parquet."""
        named = {key: row[key] for key in ("experiment", "role", "output", "unit", "samples")}
        return cls(**named, before=row["rmse_before"], after=row["rmse_after"])


@dataclass(frozen=True)
class RepairedModel:
    """A model with the estimates and effects of a run.

    Attributes
    ----------
    run
        Name of the run's folder.
    problem, description
        The simulated problem, including all effects, and the FMU's model description.
    effects
        Active effects at the estimates, in the order in which they act.
    coefficients
        Coefficients of each of these effects.
    parameters
        The values of the FMU's own parameters and initial states.
    known
        Other known values of the experiment.
    notes
        Sentences on differences from the run.
    ranges
        For each effect, the range of its variable in the data, as text; missing if unknown.
    errors
        Errors that the run reports.
    without
        The model of the errors "before", as part of a sentence.
    of_experiments
        By id of the experiment, the values of the FMU's parameters and initial states, and of
        coefficients that differ between experiments, by the exported FMU's names.
    """

    run: str
    problem: Problem
    description: ModelDescription
    effects: tuple[EffectDefinition, ...]
    coefficients: tuple[tuple[EstimatedValue, ...], ...]
    parameters: tuple[EstimatedValue, ...]
    known: tuple[tuple[str, Value], ...]
    notes: tuple[str, ...]
    errors: tuple[ReportedError, ...] = ()
    ranges: Mapping[str, str] = field(default_factory=dict)
    without: str = "the original FMU at the start values"
    of_experiments: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @cached_property
    def positions(self) -> tuple[int, ...]:
        """Index of the first coefficient of each effect among all coefficients."""
        return tuple(np.cumsum([0, *map(len, self.coefficients)])[:-1].tolist())


def describe_repair(repair: RepairedModel) -> str:
    """Return all results of a run, as plain text."""
    lines = ["Parameters", *(_line(found) for found in repair.parameters)]
    lines = lines if repair.parameters else []
    return "\n".join([*lines, *([""] if lines else []), describe_effects(repair)])


def describe_effects(repair: RepairedModel) -> str:
    """Return the effects as text: site, equation and coefficients of each."""
    if not repair.effects:
        return "No effects were added.\n"
    lines = ["Effects"]
    for effect, values in zip(repair.effects, repair.coefficients, strict=True):
        lines += [f"  {effect.effect.name} ({effect.form.name}) at {effect.site}"]
        lines += [f"    {effect_equation(effect)}"]
        prefix = f"{effect.effect.name}."
        lines += [f"  {_line(value, prefix)}" for value in values]
        if effect.effect.name in repair.ranges:
            lines += [
                (
                    f"    estimated over {repair.ranges[effect.effect.name]}; extrapolated outside "
                    "this range"
                )
            ]
    return "\n".join(lines) + "\n"


def effect_equation(effect: EffectDefinition) -> str:
    """Return the equation of an effect as readable text."""
    if not effect.effect.equation:
        return equation_text(effect.effect, effect.form, effect.site)
    own = effect.effect
    if effect.site.other:
        first, second = effect.site.targets
        return f"der({first}) += {own.equation}, der({second}) += {own.reaction}"
    sign = "+=" if effect.site.at_rates else "->"
    left = str(effect.site) if effect.site.at_rates else effect.site.target
    return f"{left} {sign} {own.equation}"


def _line(found: EstimatedValue, prefix: str = "") -> str:
    unit = f" {found.unit}" if found.unit not in ("", "1") else ""
    interval = f"  ({found.interval})" if found.interval else ""
    return f"  {found.name.removeprefix(prefix)} = {found.value:.6g}{unit}{interval}"


MOST_NAMED_EXPERIMENTS = 4
"""Largest number of experiments that a note names."""


@dataclass(frozen=True)
class ParameterReader:
    """Looks up values in a run's table of parameters."""

    problem: Problem
    description: ModelDescription
    rows: Mapping[str, Row]
    experiment: Experiment | None

    def repair(self, run: str) -> RepairedModel:
        """Return the repaired model of a run with this name."""
        problem = self.problem
        count = len(problem.model.parameters)
        named = [p for p in problem.parameters if not p.auxiliary]
        known = dict(self.experiment.values) if self.experiment is not None else {}
        found = [(p, self._find(p)) for p in named[:count] if p.target not in known]
        absent = [p.name for p, value in found if value is None and p.per != "gap"]
        effects, coefficients, left = self._effects(named[count:])
        absent += [p.name for p in named[count:] if self._find(p) is None]
        notes = list(left)
        if absent:
            notes.append(self._absent(absent))
        return RepairedModel(
            run,
            problem,
            self.description,
            effects,
            coefficients,
            tuple(value for _, value in found if value is not None),
            tuple(known.items()),
            tuple(notes),
            of_experiments=self._of_experiments(named, effects),
        )

    def _absent(self, names: Sequence[str]) -> str:
        """Return which parameters keep their starts, and how to select an experiment's values."""
        one = len(names) == 1
        targets = {p.name: p.target for p in self.problem.parameters}
        starts = [self.description.variables.get(targets[name]) for name in names]
        known = [
            f"{name} = {start.start:g}"
            for name, start in zip(names, starts, strict=True)
            if start is not None and start.start is not None
        ]
        ids = [e.id for e in self.problem.experiments]
        more = ", ..." if len(ids) > MOST_NAMED_EXPERIMENTS else ""
        return (
            f"{', '.join(names)} {'has' if one else 'have'} a value for each experiment, so the "
            "exported FMU keeps the start "
            f"value{'' if one else 's'}{' (' + ', '.join(known) + ')' if known else ''}; to use "
            "the values of one experiment, give --experiment ID, or experiment=ID in Python, with "
            f"one of {', '.join(ids[:MOST_NAMED_EXPERIMENTS])}{more}"
        )

    def _of_experiments(
        self, named: Sequence[Parameter], effects: Sequence[EffectDefinition]
    ) -> dict[str, dict[str, float]]:
        """Return the values of each experiment whose values are all known."""
        count = len(self.problem.model.parameters)
        kept = {f"{e.effect.name}.{c}" for e in effects for c in coefficient_names(e.effect)}
        own = [p for p in named[count:] if p.name in kept and (p.per or p.expression)]
        found: dict[str, dict[str, float]] = {}
        for experiment in self.problem.experiments:
            reader = replace(self, experiment=experiment)
            known = dict(experiment.values)
            begun = {own.variable for own in experiment.own_starts}
            wanted = [
                p
                for p in (*named[:count], *own)
                if p.target not in known and (p.per != "gap" or p.target in begun)
            ]
            values = {p.target: reader._find(p) for p in wanted}
            there = {name: value.value for name, value in values.items() if value is not None}
            if len(there) == len(values):
                found[experiment.id] = there
        return found

    def _effects(
        self, parameters: list[Parameter]
    ) -> tuple[tuple[EffectDefinition, ...], tuple[tuple[EstimatedValue, ...], ...], list[str]]:
        problem = self.problem
        kept, coefficients, notes, at = [], [], [], 0
        for definition in define_all(
            problem.effects, self.description, problem.model.interface, problem.experiments
        ):
            effect = definition.effect
            own = parameters[at : at + len(definition.coefficients)]
            at += len(own)
            if effect.is_noise:
                notes.append(
                    f"effect {effect.name!r} is process noise and is left out: the errors of the "
                    "run are those of predictions, so they differ from the errors of a simulation "
                    "of the exported model"
                )
                continue
            units = coefficient_units(definition, self.description)
            values = tuple(
                self._find(p, unit) or EstimatedValue(p.name, unit, p.start)
                for p, unit in zip(own, units, strict=True)
            )
            if definition.is_neutral(np.array([value.value for value in values])):
                notes.append(
                    f"effect {effect.name!r} is left out, because it has no influence at its values"
                )
                continue
            kept.append(definition)
            coefficients.append(values)
        return tuple(kept), tuple(coefficients), notes

    def _find(self, parameter: Parameter, unit: str = "") -> EstimatedValue | None:
        """Return the value of a parameter; None for different values and no chosen experiment."""
        label = parameter.name
        if self.experiment is not None:
            label = label_of(parameter, self.experiment)
            label = label if label in self.rows else f"{parameter.name}[{self.experiment.id}]"
            label = label if label in self.rows else parameter.name
        row = self.rows.get(label)
        if row is None and (parameter.fixed and not parameter.expression):
            return EstimatedValue(parameter.target, parameter.unit or unit, parameter.start)
        if row is None:
            return None
        unit = row["unit"] or parameter.unit or unit
        return EstimatedValue(
            parameter.target,
            "" if UNKNOWN_UNIT in unit else unit,
            row["value"],
            row["lower95"] if not row["at_bound"] else math.nan,
            row["upper95"] if not row["at_bound"] else math.nan,
            row["lower"],
            row["upper"],
        )


Row = Mapping[str, Any]
FITTED = "the original FMU with fitted parameters"
"""The model of the errors of a closed loop before its repair."""


def gather(
    run_folder: Path, config: Path | None, experiment: str | None, *, allow_code: bool
) -> RepairedModel:
    """Read the inputs and the results of a run.

    Parameters
    ----------
    run_folder
        Folder of a finished fit or closed loop.
    config
        The original config of the run, if it has moved.
    experiment
        The experiment whose values are used if they differ; None for shared values only.
    allow_code
        Whether Python functions named in the config may run.

    Raises
    ------
    ClusterEstError
        If the run is not finished, its files are missing, or the FMU has changed.
    """
    facts = read_facts(run_folder)
    table = run_folder / "parameters.parquet"
    if not table.is_file():
        check_has_estimates(run_folder)
        raise RunFolderError(
            f"{run_folder}: must be the folder of a finished run, but the status of the run is "
            f"{facts.get('status')!r}; finish it with --resume"
        )
    if not facts.get("config_hash"):
        raise RunFolderError(
            f"{run_folder}: an export needs the config of the run, but this run was saved from "
            "Python without one; use cluster_est.export(result, ...) in Python"
        )
    problem = _problem(run_folder, facts, config, allow_code=allow_code)
    _check_same(run_folder, facts, problem)
    chosen = _experiment(problem, experiment)
    rows = {row["label"]: row for row in read_run_table(table)}
    description = problem.describe()
    repair = ParameterReader(problem, description, rows, chosen).repair(run_folder.resolve().name)
    path = run_folder / "errors.parquet"
    errors = read_run_table(path) if path.is_file() else []
    shapes = run_folder / "shapes.parquet"
    ranges = _ranges(read_run_table(shapes)) if shapes.is_file() else {}
    repair = dataclasses.replace(repair, ranges=ranges)
    return _with_errors(repair, errors, fitted=facts.get("verdict") is not None)


def repaired(
    problem: Problem,
    estimates: Sequence[Estimate],
    experiment: str | None,
    errors: Sequence[Row],
    *,
    fitted: bool = False,
) -> RepairedModel:
    """Return a repaired model for a result in memory.

    Parameters
    ----------
    problem
        The problem with all effects.
    estimates
        Estimates for it.
    experiment
        As in `gather`.
    errors
        Rows of the table of errors.
    fitted
        Whether the errors before are those of a fit, as for a closed loop.
    """
    rows = {each.label: dataclasses.asdict(each) for each in estimates}
    chosen = _experiment(problem, experiment)
    repair = ParameterReader(problem, problem.describe(), rows, chosen).repair("result")
    return _with_errors(repair, errors, fitted=fitted)


def _ranges(shapes: Sequence[Row]) -> dict[str, str]:
    """Return for each effect the range of its variable in the data."""
    found = {}
    for row in shapes:
        if row["x"] and row["variable"]:
            unit = row["variable_unit"]
            unit = f" {unit}" if unit not in ("", "1") else ""
            low, high = min(row["x"]), max(row["x"])
            found[row["effect"]] = f"{row['variable']} from {low:.4g} to {high:.4g}{unit}"
    return found


def _with_errors(repair: RepairedModel, errors: Sequence[Row], *, fitted: bool) -> RepairedModel:
    found = tuple(ReportedError.of(row) for row in errors)
    without = FITTED if fitted else repair.without
    return dataclasses.replace(repair, errors=found, without=without)


def _problem(run_folder: Path, facts: Row, config: Path | None, *, allow_code: bool) -> Problem:
    """Return the problem of the last fit, which includes effects added by a closed loop."""
    path, text = run_folder / "config.toml", read_config_text(run_folder)
    try:
        raw = tomllib.loads(text)
    except ValueError as error:
        raise RunFolderError(
            f"{path}: cannot be read ({error}); this file is a part of the run, so restore it"
        ) from error
    resolved = with_found_effects(parse_config(raw, str(path)), facts)
    return build_problem(resolved, config_base(run_folder, config), allow_code=allow_code)


def _check_same(run_folder: Path, facts: Row, problem: Problem) -> None:
    then, now = facts["fmu"]["sha256"], problem.model.archive_hash
    if then != now:
        raise RunFolderError(
            f"{run_folder}: {problem.model.name} must be the FMU of the run, but has changed "
            "since; restore that FMU, or fit again"
        )


def _experiment(problem: Problem, name: str | None) -> Experiment | None:
    if name is None:
        return None
    known = {experiment.id: experiment for experiment in problem.experiments}
    if name not in known:
        raise RunFolderError(
            f"experiment: must be an experiment of the run, but is {name!r}{nearest(name, known)}"
        )
    return known[name]
