"""A joint estimation: the model, the experiments, and the parameters to estimate."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from cluster_est.errors import ProblemError
from cluster_est.plug_in import check_options
from cluster_est.problem import display
from cluster_est.problem.costs import Cost, SumSquared
from cluster_est.problem.formulas import Formula, ParameterConstraint
from cluster_est.problem.given_cost import as_cost
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.sigmas import mixed_sigmas
from cluster_est.problem.tables.gaps import RecordGap, gap_findings
from cluster_est.problem.tables.jumps import jump_findings, jumping_inputs
from cluster_est.problem.tables.sources import TableSource
from cluster_est.problem.tables.sparse_inputs import sparse_inputs
from cluster_est.problem.tables.stand_ins import of_experiment, stand_in_findings
from cluster_est.problem.variables import (
    check_effects,
    check_experiment,
    check_interface,
    check_names,
    check_parameters,
    check_signals,
    coefficient_names,
    refuse_repeated,
    with_units,
)
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription, describe_model, nearest
from workers.messages import Effect, Experiment, Model
from workers.messages.checks import as_pairs, as_tuple, check_kind, check_text
from workers.messages.types import by_content
from workers.simulation.fixed_step import communication_notes


@by_content
@dataclass(frozen=True, repr=False)
class Problem:
    """One joint estimation: a model, the parameters to estimate, and the experiments.

    Tuples may be given as lists.

    Attributes
    ----------
    model, experiments
        The simulated model, and the measured experiments.
    cost
        The cost to minimise. It may be given by name, such as "huber", or as a function of all
        residuals that returns a number; see `FunctionCost`.
    parameters
        Parameters of the model, followed by the coefficients of the effects, which are called
        "EFFECT.COEFFICIENT". Auxiliary parameters may be anywhere. If the model lists no
        parameters, it gets these. Otherwise it must list the same ones in the same order.
    effects
        Terms that are added to the model.
    constraints
        Constraints on parameters; constraints on signals belong to the experiments.
    units
        Pairs (variable of the FMU or signal, unit) for units that the FMU does not declare, or
        declares wrongly; may be given as a dict. They appear only in tables and texts; no number is
        converted.
    tables
        The files of the experiments, used to find unused columns. No fit depends on them.
    gaps
        The gaps of the records, and their treatment, from `split_at_gaps`. No result depends on
        them.

    Raises
    ------
    ProblemError
        If names repeat, or experiments and parameters contradict each other.
    ModelError
        If the FMU has no variable of a name.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    experiments: tuple[Experiment, ...]
    cost: Cost = field(default_factory=SumSquared)
    effects: tuple[Effect, ...] = ()
    constraints: tuple[ParameterConstraint, ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    tables: tuple[TableSource, ...] = ()
    gaps: tuple[RecordGap, ...] = ()

    def __post_init__(self) -> None:
        self._check_kinds()
        refuse_repeated("experiment id", [e.id for e in self.experiments])
        refuse_repeated("parameter", [p.name for p in self.parameters])
        refuse_repeated("variable", [p.target for p in self.parameters])
        refuse_repeated("effect", [e.name for e in self.effects])
        names = [f"{e.name}.{c}" for e in self.effects for c in coefficient_names(e)]
        targets = [p.target for p in self.parameters if not p.auxiliary]
        if not self.model.parameters:
            own = tuple(target for target in targets if target not in names)
            object.__setattr__(self, "model", replace(self.model, parameters=own))
        if targets != [*self.model.parameters, *names]:
            raise ProblemError(
                "parameters: must be the parameters of the model, then the coefficients of the "
                f"effects, in the order {[*self.model.parameters, *names]}, but are {targets}; "
                "reorder them"
            )
        named = [p for p in self.parameters if not p.auxiliary]
        check_names(self.model, named[: len(self.model.parameters)], self.experiments)
        self.derived  # noqa: B018 - raises errors immediately
        if not any(e.role == "train" for e in self.experiments):
            raise ProblemError(
                'experiments: at least one must have role = "train" (parameters are estimated from '
                "these experiments), but none has; change a role"
            )
        for experiment in self.experiments:
            asked = experiment.constraint_names or experiment.cost_function is not None
            if experiment.size == 0 and not asked and not self.constraints:
                raise ProblemError(
                    f"experiment {experiment.id!r}: must have at least one measured value between "
                    f"{experiment.start:g} and {experiment.stop:g} s, but has none; check start, "
                    "stop and windows"
                )

    def _check_kinds(self) -> None:
        """Refuse values of a wrong class, and convert lists to tuples."""
        advice = "; make one with read_model(path)"
        check_kind(self.model, Model, "problem.model", ProblemError, advice)
        object.__setattr__(self, "cost", as_cost(self.cost))
        advice = '; give a cost, the name of one such as "huber", or a function of residuals'
        check_kind(self.cost, Cost, "problem.cost", ProblemError, advice)
        check_options(self.cost, "cost.options", ProblemError)
        for key, kind in _PROBLEM_LISTS.items():
            found: tuple[object, ...] = as_tuple(
                getattr(self, key), kind, f"problem.{key}", ProblemError
            )
            object.__setattr__(self, key, found)
        units = as_pairs(self.units, "model.units", ProblemError)
        for name, unit in units:
            check_text(unit, dotted("model", "units", name), ProblemError)
        object.__setattr__(self, "units", units)

    @cached_property
    def derived(self) -> tuple[tuple[int, Formula], ...]:
        """Positions and formulas of the parameters that are computed from others.

        Each one comes after the parameters that it needs.
        """
        names = tuple(p.name for p in self.parameters)
        waiting = {
            i: Formula(p.expression, names, f"{dotted('parameters', p.name)}.expression")
            for i, p in enumerate(self.parameters)
            if p.expression
        }
        found: list[tuple[int, Formula]] = []
        while waiting:
            ready = [i for i, f in waiting.items() if not any(names[j] in f.names for j in waiting)]
            if not ready:
                first = names[next(iter(waiting))]
                raise ProblemError(
                    f"{dotted('parameters', first)}.expression: must not depend on itself, but "
                    f"does, through {', '.join(names[i] for i in waiting)}; give one of them a "
                    "start instead"
                )
            found += [(i, waiting.pop(i)) for i in ready]
        return tuple(found)

    @property
    def plain(self) -> bool:
        """Whether there are only residuals of outputs at measured times, and no constraints."""
        curved = any(e.curve is not None or e.cost_function is not None for e in self.experiments)
        bound = any(e.constraint_names for e in self.experiments)
        return not (curved or bound or self.constraints)

    def indices(self, role: str) -> tuple[int, ...]:
        """Return the positions of the experiments with this role."""
        return tuple(i for i, e in enumerate(self.experiments) if e.role == role)

    def describe(self) -> ModelDescription:
        """Read the FMU's description and check every name against it.

        Raises
        ------
        ModelError, ProblemError
            If the FMU lacks a variable or does not allow it to be used in this way.
        """
        signals = {given.variable for e in self.experiments for given in e.signals}
        description = with_units(describe_model(self.model), self.units, signals)
        check_interface(self.model, description)
        named = [p for p in self.parameters if not p.auxiliary]
        for experiment in self.experiments:
            check_signals(experiment, description)
        check_effects(self.effects, description, self.model, self.experiments)
        check_parameters(named[: len(self.model.parameters)], description)
        for experiment in self.experiments:
            check_experiment(experiment, description, self.model, self.parameters)
        return description

    def notes(self, settled: Collection[str] = ()) -> tuple[str, ...]:
        """Return notes for the user on the simulation of the FMU, and on the data.

        `settled` are the inputs whose interpolation is known to be right.

        Raises
        ------
        ModelError, ProblemError
            As `describe`, or if the FMU cannot be simulated at the experiments' times.
        """
        inputs = [said for name, said in self.input_notes() if name not in settled]
        return (*self.model_notes(), *self.data_notes(), *inputs)

    def input_notes(self) -> tuple[tuple[str, str], ...]:
        """Return inputs that may need a hold, each with a note; raises as `notes`."""

        def holds(name: str) -> bool:
            return self.describe().holds(name)

        def unit_of(name: str) -> str:
            return self.describe().unit_of(name)

        jumping = jumping_inputs(self.experiments, holds)
        found = jump_findings(self.experiments, holds, self.columns, unit_of)
        named = [*zip(jumping, found, strict=True)]
        sparse = sparse_inputs(self.experiments, holds)
        named += [(s.variable, s.finding(self.columns)) for s in sparse if s.at_changes]
        return tuple((name, ": ".join(words)) for name, words in named)

    def model_notes(self) -> tuple[str, ...]:
        """Return only the notes on the simulation of the FMU; raises as `notes`."""
        if self.model.interface == "model_exchange":
            return ()
        return communication_notes(self.model, self.describe(), self.experiments)

    def data_notes(self) -> tuple[str, ...]:
        """Return notes on numbers that are probably not measurements, on gaps, and on sigmas."""
        gaps = [(said, do) for said, do, _ in gap_findings(self.gaps)]
        found = [*gaps, *self.data_findings, *mixed_sigmas(self.experiments)]
        return tuple(f"{said}: {do}" if do else said for said, do in found)

    @property
    def signal_units(self) -> dict[str, str]:
        """Units of measured signals: those that the user gives, or those in the tables.

        A signal with several units in the tables has none.
        """
        found: dict[str, set[str]] = {}
        for table in self.tables:
            for name, unit in table.signal_units:
                found.setdefault(name, set()).add(unit)
        known = {name: min(units) for name, units in found.items() if len(units) == 1}
        return known | dict(self.units)

    @property
    def columns(self) -> dict[str, str]:
        """The known columns of the tables, by the keys of a config."""
        return {
            key: column
            for table in reversed(self.tables)
            for key, column in (*table.named, *table.clocks)
        }

    @cached_property
    def data_findings(self) -> tuple[tuple[str, str], ...]:
        """Finding and advice for each number that is probably not a measurement."""
        read = {each.experiment for each in self.tables}
        found = [each for table in self.tables for each in table.stand_ins]
        found += [
            each
            for run in self.experiments
            if run.record_id not in read
            for each in of_experiment(run)
        ]
        return stand_in_findings(found, [each for table in self.tables for each in table.missing])

    def fix(self, *names: str) -> Problem:
        """Return the problem with parameters fixed at their start values, without their priors.

        Raises
        ------
        ProblemError
            If there is no parameter of that name.
        """
        return self._changed({name: {"fixed": True, "prior": None} for name in names})

    def free(self, name: str, *, bounds: tuple[float, float] | None = None) -> Problem:
        """Return the problem with a parameter that is estimated, within new bounds if given.

        Raises
        ------
        ProblemError
            If there is no parameter with this name, or its start value is outside the bounds.
        """
        change: dict[str, Any] = {"fixed": False}
        return self._changed({name: change if bounds is None else change | {"bounds": bounds}})

    def with_values(self, values: Mapping[str, float]) -> Problem:
        """Return the problem with other start values; fixed parameters keep these values.

        A parameter with a value for each experiment has one start value for all of them.

        Raises
        ------
        ProblemError
            If there is no parameter with this name, or a start value is outside its bounds.
        """
        advice = '; write a table of names and values such as {"k": 25.0}'
        check_kind(values, Mapping, "with_values", ProblemError, advice)
        return self._changed({name: {"start": value} for name, value in values.items()})

    def _changed(self, changes: Mapping[str, Mapping[str, Any]]) -> Problem:
        names = [p.name for p in self.parameters]
        for name in changes:
            if name not in names:
                raise ProblemError(f"parameters: there is no {name!r}{nearest(str(name), names)}")
        changed = (replace(p, **changes.get(p.name, {})) for p in self.parameters)
        return replace(self, parameters=tuple(changed))

    def __repr__(self) -> str:
        free = ", ".join(p.name for p in self.parameters if _kind(p) not in ("fixed",))
        count = len(self.experiments)
        return f"Problem({self.model.name}: {free}; {count} experiment{'s' * (count != 1)})"

    def _repr_html_(self) -> str:
        """Return model, parameters and experiments as HTML for a notebook."""
        model = self.model
        kind = model.interface.replace("_", " ")
        title = f"Problem: {model.name}, {kind}, solver {model.solver.name}, cost {self.cost.name}"
        parameters = [
            (p.name, p.start, p.lower, p.upper, p.unit, _kind(p)) for p in self.parameters
        ]
        experiments = [
            (e.id, e.role, e.start, e.stop, ", ".join(o.variable for o in e.outputs), str(e.size))
            for e in self.experiments
        ]
        return display.section(
            title,
            display.DisplayTable(
                "Parameters", ("name", "start", "lower", "upper", "unit", "kind"), parameters
            ),
            display.DisplayTable(
                "Experiments",
                ("id", "role", "from [s]", "to [s]", "outputs", "residuals"),
                experiments,
            ),
        )


_PROBLEM_LISTS: dict[str, type] = {
    "parameters": Parameter,
    "experiments": Experiment,
    "effects": Effect,
    "constraints": ParameterConstraint,
    "tables": TableSource,
    "gaps": RecordGap,
}
"""The lists of a problem, and the class of their entries."""


def _kind(parameter: Parameter) -> str:
    """Return in a few words how a parameter is estimated."""
    if parameter.expression:
        return f"= {parameter.expression}"
    if parameter.fixed:
        return "fixed"
    return f"one for each {parameter.per}" if parameter.per else "shared"
