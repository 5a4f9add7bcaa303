"""The values of a run's table of parameters, for the FMU and for the effects around it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cluster_est.export.repaired_model import EstimatedValue, RepairedModel
from cluster_est.problem.names import coefficient_names
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space.parameter_constraints import label_of
from workers.effects.definition import EffectDefinition, define_all
from workers.effects.units import UNKNOWN, coefficient_units
from workers.fmu.description import ModelDescription
from workers.messages import Experiment

MOST_NAMED = 4
"""Experiments in a note."""


@dataclass(frozen=True)
class ParameterReader:
    """Looks up values in a run's table of parameters."""

    problem: Problem
    description: ModelDescription
    rows: Mapping[str, Row]
    experiment: Experiment | None

    def repair(self, run: str) -> RepairedModel:
        """Gather all that the export of a run of this name needs."""
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
        """Say which parameters keep their starts, and how to choose the values of an experiment."""
        one = len(names) == 1
        targets = {p.name: p.target for p in self.problem.parameters}
        starts = [self.description.variables.get(targets[name]) for name in names]
        known = [
            f"{name} = {start.start:g}"
            for name, start in zip(names, starts, strict=True)
            if start is not None and start.start is not None
        ]
        ids = [e.id for e in self.problem.experiments]
        more = ", ..." if len(ids) > MOST_NAMED else ""
        return (
            f"{', '.join(names)} {'has' if one else 'have'} a value for each experiment and "
            f"{'keeps its' if one else 'keep their'} start in the exported FMU"
            f"{' (' + ', '.join(known) + ')' if known else ''}; choose the values of one with "
            f"--experiment ID, in Python experiment=ID, of {', '.join(ids[:MOST_NAMED])}{more}"
        )

    def _of_experiments(
        self, named: Sequence[Parameter], effects: Sequence[EffectDefinition]
    ) -> dict[str, dict[str, float]]:
        """Return the values of each experiment of which all are known."""
        count = len(self.problem.model.parameters)
        kept = {f"{e.effect.name}.{c}" for e in effects for c in coefficient_names(e.effect)}
        own = [p for p in named[count:] if p.name in kept and (p.per or p.expression)]
        found: dict[str, dict[str, float]] = {}
        for experiment in self.problem.experiments:
            reader = replace(self, experiment=experiment)
            known = dict(experiment.values)
            wanted = [p for p in (*named[:count], *own) if p.target not in known]
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
                    f"effect {effect.name!r} is process noise and is left out: the run's errors "
                    "are those of predictions, and a simulation of the exported model has others"
                )
                continue
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
