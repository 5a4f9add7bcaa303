"""The model of a run with its estimates and effects, gathered from its folder for an export."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.config.build import build_problem
from cluster_est.config.reader import EffectSection, parse_config
from cluster_est.errors import RunFolderError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.parameter_constraints import label_of
from cluster_est.problem.problem import Problem
from cluster_est.results.row_types import Estimate
from cluster_est.run_folder.reading import read_facts, read_run_table
from cluster_est.run_folder.replay import config_base
from workers.effects.definition import EffectDefinition, define
from workers.effects.units import UNKNOWN, coefficient_units
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Experiment, Value

Row = Mapping[str, Any]


@dataclass(frozen=True)
class EstimatedValue:
    """One estimated value.

    Attributes
    ----------
    name, unit, value
        The FMU's name for it, or "EFFECT.COEFFICIENT".
    low, high
        Its 95 % interval; NaN where the data do not determine it, or it was not estimated.
    lower, upper
        Its bounds, infinite where it has none.
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
class RepairedModel:
    """A model with the estimates and effects of a run.

    Attributes
    ----------
    run
        Name of the run's folder.
    problem, description
        What was simulated, all effects included.
    effects
        Those that do something with the values that were found, in the order in which they act.
    coefficients
        Of each of these effects.
    parameters
        The values of the FMU's own parameters and initial states.
    known
        The values that the experiment had besides.
    notes
        Sentences on what is not as in the run.
    """

    run: str
    problem: Problem
    description: ModelDescription
    effects: tuple[EffectDefinition, ...]
    coefficients: tuple[tuple[EstimatedValue, ...], ...]
    parameters: tuple[EstimatedValue, ...]
    known: tuple[tuple[str, Value], ...]
    notes: tuple[str, ...]

    @cached_property
    def positions(self) -> tuple[int, ...]:
        """Index of the first coefficient of each effect among those of all."""
        return tuple(np.cumsum([0, *map(len, self.coefficients)])[:-1].tolist())


def gather(
    run_folder: Path, config: Path | None, experiment: str | None, *, allow_code: bool
) -> RepairedModel:
    """Read what a run was made from and what it has found.

    Parameters
    ----------
    run_folder
        Of a finished fit or closed loop.
    config
        The config that it was made from, if that has moved.
    experiment
        Whose values are taken, where parameters have one for each; None for shared values alone.
    allow_code
        Whether Python functions that the config names may run.

    Raises
    ------
    ClusterEstError
        If the run is not finished, its files are gone, or the FMU is another now.
    """
    facts = read_facts(run_folder)
    table = run_folder / "parameters.parquet"
    if not table.is_file():
        raise RunFolderError(
            f"{run_folder}: must be the folder of a finished run but is {facts.get('status')!r}; "
            "finish it with --resume"
        )
    if not facts.get("config_hash"):
        raise RunFolderError(
            f"{run_folder}: was saved from Python and has no config to be exported from; use "
            "result.export(...) there"
        )
    problem = _problem(run_folder, facts, config, allow_code=allow_code)
    _check_same(run_folder, facts, problem)
    chosen = _experiment(problem, experiment)
    rows = {row["label"]: row for row in read_run_table(table)}
    description = problem.describe()
    reader = _ParameterReader(problem, description, rows, chosen)
    return reader.repair(run_folder.resolve().name)


def repaired(
    problem: Problem, estimates: Sequence[Estimate], experiment: str | None, run: str = "result"
) -> RepairedModel:
    """The same from a result in memory.

    Parameters
    ----------
    problem
        With all effects.
    estimates
        What was found for it.
    experiment
        As of `gather`.
    run
        The name that takes the place of the folder's.
    """
    rows = {each.label: dataclasses.asdict(each) for each in estimates}
    chosen = _experiment(problem, experiment)
    return _ParameterReader(problem, problem.describe(), rows, chosen).repair(run)


def _problem(run_folder: Path, facts: Row, config: Path | None, *, allow_code: bool) -> Problem:
    """The problem of the last fit: a closed loop has added effects to that of its config."""
    path = run_folder / "config.toml"
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path}: cannot be read ({error}); it belongs to the run") from error
    resolved = parse_config(raw, str(path))
    found = [tomllib.loads(effect["config"])["effects"][0] for effect in facts.get("effects", [])]
    names = {section.name or section.form for section in resolved.effects}
    added = [EffectSection(**each) for each in found if each["name"] not in names]
    resolved = resolved.model_copy(update={"effects": [*resolved.effects, *added]})
    return build_problem(resolved, config_base(run_folder, config), allow_code=allow_code)


def _check_same(run_folder: Path, facts: Row, problem: Problem) -> None:
    then, now = facts["fmu"]["sha256"], problem.model.archive_hash
    if then != now:
        raise RunFolderError(
            f"{run_folder}: {problem.model.name} must be the FMU that the run was made with but "
            "has changed since; put that one back, or fit again"
        )


def _experiment(problem: Problem, name: str | None) -> Experiment | None:
    if name is None:
        return None
    known = {experiment.id: experiment for experiment in problem.experiments}
    if name not in known:
        raise RunFolderError(
            f"experiment: must be an experiment of the run but is {name!r}{nearest(name, known)}"
        )
    return known[name]


@dataclass(frozen=True)
class _ParameterReader:
    """Looks up values in a run's table of parameters."""

    problem: Problem
    description: ModelDescription
    rows: Mapping[str, Row]
    experiment: Experiment | None

    def repair(self, run: str) -> RepairedModel:
        problem = self.problem
        count = len(problem.model.parameters)
        named = [p for p in problem.parameters if not p.auxiliary]
        known = dict(self.experiment.values) if self.experiment is not None else {}
        found = [(p, self._find(p)) for p in named[:count] if p.target not in known]
        absent = [p.name for p, value in found if value is None]
        effects, coefficients, left = self._effects(named[count:])
        absent += [p.name for p in named[count:] if self._find(p) is None]
        notes = list(left)
        if absent:
            one = len(absent) == 1
            notes.append(
                f"{', '.join(absent)} {'has' if one else 'have'} a value for each experiment and "
                f"{'keeps its' if one else 'keep their'} start; choose the values of one with "
                "experiment"
            )
        return RepairedModel(
            run,
            problem,
            self.description,
            effects,
            coefficients,
            tuple(value for _, value in found if value is not None),
            tuple(known.items()),
            tuple(notes),
        )

    def _effects(
        self, parameters: list[Parameter]
    ) -> tuple[tuple[EffectDefinition, ...], tuple[tuple[EstimatedValue, ...], ...], list[str]]:
        interface = self.problem.model.interface
        named = [given.variable for e in self.problem.experiments for given in e.signals]
        signals = tuple(dict.fromkeys(named))
        kept, coefficients, notes, at = [], [], [], 0
        for effect in self.problem.effects:
            definition = define(effect, self.description, interface, signals)
            own = parameters[at : at + len(definition.coefficients)]
            at += len(own)
            units = coefficient_units(definition, self.description)
            values = tuple(
                self._find(p, unit) or EstimatedValue(p.name, unit, p.start)
                for p, unit in zip(own, units, strict=True)
            )
            if definition.is_neutral(np.array([value.value for value in values])):
                notes.append(f"effect {effect.name!r} does nothing at its values and is left out")
                continue
            kept.append(definition)
            coefficients.append(values)
        return tuple(kept), tuple(coefficients), notes

    def _find(self, parameter: Parameter, unit: str = "") -> EstimatedValue | None:
        """The value of a parameter, None if it has one for each experiment and none was chosen."""
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
            "" if UNKNOWN in unit else unit,
            row["value"],
            row["lower95"] if not row["at_bound"] else math.nan,
            row["upper95"] if not row["at_bound"] else math.nan,
            row["lower"],
            row["upper"],
        )
