"""What is to be estimated, from which experiments, with which model."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from cluster_est.costs.base import Cost
from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.problem.formulas import Formula, ParameterConstraint
from cluster_est.results import notebook
from workers.fmu.description import ModelDescription, describe_model, nearest
from workers.fmu.variable import ModelVariable
from workers.messages import Effect, Experiment, Model, Value
from workers.simulation.fixed_step import communication_notes

Scale = Literal["linear", "log"]


@dataclass(frozen=True)
class Parameter:
    """A value to estimate: a parameter of the model or an initial state.

    Attributes
    ----------
    name
        What the user calls it.
    start
        Where the estimation starts; the value itself if `fixed`.
    lower, upper
        Bounds, in the same physical unit as `start`.
    scale
        "log" for a positive value whose order of magnitude is in doubt: methods then see its
        logarithm.
    fixed
        Keep it at `start`.
    variable
        The FMU's name for it; `name` if empty.
    per
        None: one value for all experiments. "experiment": one for each. "group:KEY": one for each
        label that the experiments have under KEY.
    unit
        For tables; filled in from the FMU if empty.
    expression
        A formula in other parameters, such as "2 * k1": the value follows from theirs and is not
        searched for. Bounds that it has become constraints.
    auxiliary
        Not a variable of the FMU: only expressions and constraints use it.
    """

    name: str
    start: float
    lower: float = -math.inf
    upper: float = math.inf
    scale: Scale = "linear"
    fixed: bool = False
    variable: str = ""
    per: str | None = None
    unit: str = ""
    expression: str = ""
    auxiliary: bool = False

    def __post_init__(self) -> None:
        where = f"parameters.{self.name}"
        if not math.isfinite(self.start):
            raise ProblemError(f"{where}.start: must be a finite number but is {self.start}")
        if not self.lower < self.upper:
            raise ProblemError(
                f"{where}.bounds: the lower bound must be below the upper one but they are "
                f"[{self.lower:g}, {self.upper:g}]; to keep a value use fixed = true"
            )
        if self.expression:
            self._check_derived(where)
        elif not self.lower <= self.start <= self.upper:
            raise ProblemError(
                f"{where}.start: must lie in its bounds [{self.lower:g}, {self.upper:g}] but is "
                f"{self.start:g}; move the start or widen the bounds"
            )
        if self.scale == "log" and (self.start <= 0.0 or self.upper <= 0.0):
            raise ProblemError(
                f"{where}.scale: a log scale needs a positive start and bounds but the start is "
                f'{self.start:g}; use scale = "linear" or positive values'
            )
        if self.per not in (None, "experiment", "group") and not re.fullmatch(
            "group:.+", self.per or ""
        ):
            raise ProblemError(
                f'{where}.per: must be "experiment" or "group:KEY" but is {self.per!r}'
            )

    def _check_derived(self, where: str) -> None:
        for key, used in (("fixed", self.fixed), ("per", self.per), ("scale", self.scale == "log")):
            if used:
                raise ProblemError(
                    f"{where}.{key}: must be left out where there is an expression, which says "
                    "all of the value; remove one of the two"
                )

    @property
    def target(self) -> str:
        """The FMU's variable."""
        return self.variable or self.name


@dataclass(frozen=True)
class Problem:
    """One joint estimation: a model, what to estimate in it, and from what.

    Attributes
    ----------
    model, experiments, cost
        What is simulated, from which measurements, and what is minimised.
    parameters
        Those of the model, in the order of `model.parameters`, then the coefficients of the
        effects, called "EFFECT.COEFFICIENT". Auxiliary ones may stand anywhere.
    effects
        Terms that are added to the model.
    constraints
        On parameters; those on signals belong to the experiments.

    Raises
    ------
    ProblemError
        If names repeat, or experiments and parameters contradict each other.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    experiments: tuple[Experiment, ...]
    cost: Cost = field(default_factory=SumSquared)
    effects: tuple[Effect, ...] = ()
    constraints: tuple[ParameterConstraint, ...] = ()

    def __post_init__(self) -> None:
        _refuse_repeated("experiment id", [e.id for e in self.experiments])
        _refuse_repeated("parameter", [p.name for p in self.parameters])
        _refuse_repeated("variable", [p.target for p in self.parameters])
        _refuse_repeated("effect", [e.name for e in self.effects])
        names = [f"{e.name}.{c}" for e in self.effects for c in coefficient_names(e)]
        targets = [p.target for p in self.parameters if not p.auxiliary]
        if targets != [*self.model.parameters, *names]:
            raise ProblemError(
                "parameters: must be those of the model and then the coefficients of the effects, "
                f"in the order {[*self.model.parameters, *names]}, but are {targets}"
            )
        self.derived  # noqa: B018 - what is wrong is said at once
        if not any(e.role == "train" for e in self.experiments):
            raise ProblemError(
                'experiments: at least one must have role = "train" but none has; parameters '
                "are estimated from those"
            )
        for experiment in self.experiments:
            asked = experiment.constraint_names or experiment.cost_function is not None
            if experiment.size == 0 and not asked and not self.constraints:
                raise ProblemError(
                    f"experiment {experiment.id!r}: must have at least one measured value between "
                    f"{experiment.start:g} and {experiment.stop:g} s but has none"
                )

    @cached_property
    def derived(self) -> tuple[tuple[int, Formula], ...]:
        """Parameters that follow from others, by position, each after those that it needs."""
        names = tuple(p.name for p in self.parameters)
        waiting = {
            i: Formula(p.expression, names, f"parameters.{p.name}.expression")
            for i, p in enumerate(self.parameters)
            if p.expression
        }
        found: list[tuple[int, Formula]] = []
        while waiting:
            ready = [i for i, f in waiting.items() if not any(names[j] in f.names for j in waiting)]
            if not ready:
                first = names[next(iter(waiting))]
                raise ProblemError(
                    f"parameters.{first}.expression: must not depend on itself but does, through "
                    f"{', '.join(names[i] for i in waiting)}; give one of them a start instead"
                )
            found += [(i, waiting.pop(i)) for i in ready]
        return tuple(found)

    @property
    def plain(self) -> bool:
        """Whether the residuals are those of outputs at measured times, without constraints."""
        curved = any(e.curve is not None or e.cost_function is not None for e in self.experiments)
        bound = any(e.constraint_names for e in self.experiments)
        return not (curved or bound or self.constraints)

    def indices(self, role: str) -> tuple[int, ...]:
        """Which experiments have this role."""
        return tuple(i for i, e in enumerate(self.experiments) if e.role == role)

    def describe(self) -> ModelDescription:
        """Read the FMU's description and check every name against it.

        Raises
        ------
        ModelError, ProblemError
            If the FMU lacks a variable or does not allow it to be used in this way.
        """
        description = describe_model(self.model)
        check_variables(self, description)
        return description

    def notes(self) -> tuple[str, ...]:
        """Say what a user should know about how the FMU is simulated.

        Raises
        ------
        ModelError, ProblemError
            As `describe`, or if it cannot be simulated at the experiments' times.
        """
        if self.model.interface == "model_exchange":
            return ()
        return communication_notes(self.model, self.describe(), self.experiments)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
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
        return notebook.section(
            title,
            notebook.DisplayTable(
                "Parameters", ("name", "start", "lower", "upper", "unit", "kind"), parameters
            ),
            notebook.DisplayTable(
                "Experiments",
                ("id", "role", "from [s]", "to [s]", "outputs", "residuals"),
                experiments,
            ),
        )


def _kind(parameter: Parameter) -> str:
    """How a parameter is estimated, in a word or two."""
    if parameter.expression:
        return f"= {parameter.expression}"
    if parameter.fixed:
        return "fixed"
    return f"one for each {parameter.per}" if parameter.per else "shared"


def check_variables(problem: Problem, description: ModelDescription) -> None:
    """Check that the FMU has every variable and lets it be used as the problem wants."""
    for experiment in problem.experiments:
        _check_signals(experiment, description)
    _check_effects(problem, description)
    named = [p for p in problem.parameters if not p.auxiliary]
    for parameter in named[: len(problem.model.parameters)]:
        _check_start(description, parameter.target, f"parameters.{parameter.name}", real=True)
    for experiment in problem.experiments:
        where = f"experiment {experiment.id!r}"
        for name, value in experiment.values:
            _check_start(description, name, f"{where}.values", real=False)
            _check_structure(problem, description.variables[name], value, where)
        for given in experiment.inputs:
            variable = description.variable(given.variable, f"{where}.inputs")
            if variable.causality != "input":
                inputs = [v.name for v in description.inputs()]
                raise ProblemError(
                    f"{where}.inputs: {given.variable!r} must be an input of {description.file} "
                    f"but is of causality {variable.causality!r}{nearest(given.variable, inputs)}"
                )
            if variable.alias_of is not None:  # given under both names, which one would count?
                raise ProblemError(
                    f"{where}.inputs: {given.variable!r} must be an input's own name but is "
                    f"another name of {variable.alias_of!r}; use that"
                )
        for name in experiment.recorded:
            variable = description.variable(name, f"{where}.outputs")
            if variable.kind not in ("real", "integer", "boolean"):
                raise ProblemError(
                    f"{where}.outputs: {name!r} must be a number of {description.file} but is of "
                    f"type {variable.kind}; choose another variable"
                )


def _check_structure(problem: Problem, variable: ModelVariable, value: Value, where: str) -> None:
    chosen = dict(problem.model.structure).get(variable.name, variable.start)
    if variable.causality == "structuralParameter" and value != chosen:
        raise ProblemError(
            f"{where}.values: {variable.name!r} says how large arrays are, so it must be the same "
            "in all experiments but is not; give it under values of the whole problem"
        )


def coefficient_names(effect: Effect) -> list[str]:
    """Names of an effect's coefficients."""
    from workers.effects.definition import coefficients  # SymPy takes long to import

    return [c.name for c in coefficients(effect, f"effect {effect.name!r}")]


def _check_effects(problem: Problem, description: ModelDescription) -> None:
    """Resolve every effect against the FMU and the signals of every experiment."""
    if not problem.effects:
        return
    from workers.effects.definition import define

    named = [tuple(given.variable for given in e.signals) for e in problem.experiments]
    every = tuple(dict.fromkeys(name for names in named for name in names))
    for effect in problem.effects:
        uses = define(effect, description, problem.model.interface, every).uses
        for experiment, names in zip(problem.experiments, named, strict=True):
            for name in uses:
                if name in every and name not in names:
                    raise ProblemError(
                        f"experiment {experiment.id!r}.signals: must have {name!r}, on which "
                        f"effect {effect.name!r} depends, but has not{nearest(name, names)}"
                    )


def _check_signals(experiment: Experiment, description: ModelDescription) -> None:
    """Refuse signals whose names mean something else already."""
    where = f"experiment {experiment.id!r}.signals"
    for given in experiment.signals:
        name = given.variable
        if name in description.variables:
            raise ProblemError(
                f"{where}.{name}: must not be the name of a variable of {description.file} but "
                "is; choose another, or put it under inputs if it is an input of the model"
            )
        if name in ("t", "s"):
            raise ProblemError(
                f"{where}.{name}: must not be named t or s, which are the time and the signal at "
                "an effect's site; choose another name"
            )
    _refuse_repeated(where, [given.variable for given in experiment.signals])


def _check_start(description: ModelDescription, name: str, where: str, *, real: bool) -> None:
    variable = description.variable(name, where)
    if not variable.settable:
        raise ProblemError(
            f"{where}: {name!r} must be a variable whose start value can be set, but "
            f"{description.file} computes it ({variable.causality}); choose a parameter or an "
            "initial state"
        )
    if real and variable.kind != "real":
        raise ProblemError(
            f"{where}: {name!r} must be a real variable to be estimated but is of type "
            f"{variable.kind}; give it as a known value instead"
        )


def _refuse_repeated(what: str, names: list[str]) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ProblemError(
            f"{what} {repeated[0]!r}: must appear once but appears twice; rename or remove one"
        )
