"""Checks the names of a problem against the variables of its FMU, and finds inputs without data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

from cluster_est.errors import ModelError, ProblemError
from cluster_est.problem.parameter import Parameter
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription, describe, nearest
from workers.fmu.variable import ModelVariable
from workers.messages import Effect, Experiment, Model, Value
from workers.messages.checks import shown

if TYPE_CHECKING:
    from cluster_est.problem.problem import Problem


def refuse_repeated(what: str, names: Sequence[str]) -> None:
    """Refuse a name that appears twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ProblemError(
            f"{what} {repeated[0]!r}: must appear once, but appears twice; rename or remove one"
        )


def coefficient_names(effect: Effect) -> list[str]:
    """Return the names of an effect's coefficients."""
    from workers.effects.definition import coefficients  # SymPy takes long to import

    return [c.name for c in coefficients(effect, f"effect {effect.name!r}")]


@lru_cache(maxsize=2)
def _description_of(model_key: tuple[str, bytes, tuple[tuple[str, int], ...]]) -> ModelDescription:
    """Return the description of an FMU, which is parsed once for many problems."""
    name, archive, structure = model_key
    return describe(name, archive, dict(structure))


def check_names(
    model: Model, parameters: Sequence[Parameter], experiments: Sequence[Experiment]
) -> None:
    """Check only that the FMU has the variables with these names, as soon as a problem is made.

    An FMU that cannot be read is reported when the problem is used.

    Raises
    ------
    ModelError
        With the nearest name.
    """
    try:
        description = _description_of((model.name, model.archive, model.structure))
    except ModelError:
        return
    for parameter in parameters:
        description.variable(parameter.target, dotted("parameters", parameter.name))
    for experiment in experiments:
        where = f"experiment {experiment.id!r}"
        for key, names in (
            ("values", [name for name, _ in experiment.values]),
            ("inputs", [given.variable for given in experiment.inputs]),
            ("outputs", experiment.recorded),
        ):
            for name in names:
                description.variable(name, f"{where}.{key}")


def check_interface(model: Model, description: ModelDescription) -> None:
    """Refuse an interface that the FMU does not offer.

    Raises
    ------
    ModelError
        If the FMU does not offer the interface.
    """
    offered = description.interfaces
    if model.interface not in offered:
        unusable = [w for w in description.warnings if w.endswith("and is left out")]
        raise ModelError(
            f"model.interface: {description.file} must offer {model.interface}, but offers only "
            f"{' and '.join(offered)}{''.join(f' ({w})' for w in unusable)}; set model.interface "
            "to an interface that it offers"
        )


def check_parameters(parameters: Sequence[Parameter], description: ModelDescription) -> None:
    """Check that each parameter is a real variable of the FMU whose start value can be set."""
    for parameter in parameters:
        _check_start(description, parameter.target, dotted("parameters", parameter.name), real=True)


def check_experiment(
    experiment: Experiment,
    description: ModelDescription,
    model: Model,
    parameters: Sequence[Parameter],
) -> None:
    """Check that the FMU has the variables of an experiment and allows this use of them."""
    where = f"experiment {experiment.id!r}"
    for name, value in experiment.values:
        _check_start(description, name, f"{where}.values", real=False)
        variable = description.variables[name]
        chosen = dict(model.structure).get(variable.name, variable.start)
        if variable.causality == "structuralParameter" and value != chosen:
            raise ProblemError(
                f"{where}.values: {variable.name!r} is the size of arrays, so it must be the same "
                "in all experiments, but is not; give it in [values], which holds for all "
                "experiments"
            )
    _check_inputs(experiment, description, where)
    for name in experiment.recorded:
        variable = description.variable(name, f"{where}.outputs")
        if variable.kind not in ("real", "integer", "boolean"):
            raise ProblemError(
                f"{where}.outputs: {name!r} must be a numeric variable of {description.file}, but "
                f"is of type {variable.kind}; choose another variable"
            )
        if variable.causality in ("parameter", "input", "independent"):
            raise ProblemError(
                f"{where}.{dotted('outputs', name)}: must be a variable that {description.file} "
                f"computes, but its causality is {variable.causality!r}; choose an output or a "
                "local variable"
            )
    _check_roles(experiment, description, parameters)
    _check_set_once(experiment, description, parameters)


def _check_set_once(
    experiment: Experiment, description: ModelDescription, parameters: Sequence[Parameter]
) -> None:
    """Refuse values for two names of the same variable."""
    where = f"experiment {experiment.id!r}"
    named = {p.target: dotted("parameters", p.name) for p in parameters if not p.auxiliary}
    named |= {
        name: f"{where}.{dotted('values', name)}"
        for name, _ in experiment.values
        if name not in named
    }
    named |= {
        given.variable: f"{where}.{dotted('inputs', given.variable)}" for given in experiment.inputs
    }
    seen: dict[str, str] = {}
    for name, place in named.items():
        variable = description.variables.get(name)
        for own in (o for o in (variable.aliases if variable is not None else ()) if o in seen):
            raise ProblemError(
                f"{place}: {name!r} is another name of {own!r}, which is already in {seen[own]}; "
                "remove one of the two"
            )
        seen[name] = place


def _check_inputs(experiment: Experiment, description: ModelDescription, where: str) -> None:
    refuse_repeated(f"{where}.inputs", [given.variable for given in experiment.inputs])
    for given in experiment.inputs:
        variable = description.variable(given.variable, f"{where}.inputs")
        if variable.causality != "input":
            inputs = [v.name for v in description.inputs()]
            raise ProblemError(
                f"{where}.inputs: {given.variable!r} must be an input of {description.file}, but "
                f"its causality is {variable.causality!r}{nearest(given.variable, inputs)}"
            )
        if variable.alias_of is not None:  # values under both names would be ambiguous
            raise ProblemError(
                f"{where}.inputs: must use the name {variable.alias_of!r} for this input, but uses "
                f"{given.variable!r}, which is another name of {variable.alias_of!r}; replace it"
            )


def check_effects(
    effects: Sequence[Effect],
    description: ModelDescription,
    model: Model,
    experiments: Sequence[Experiment],
) -> None:
    """Check every effect against the FMU and the signals of every experiment."""
    if not effects:
        return
    from workers.effects.definition import define_all

    named = [tuple(given.variable for given in e.signals) for e in experiments]
    every = {name for names in named for name in names}
    for definition in define_all(effects, description, model.interface, experiments):
        for experiment, names in zip(experiments, named, strict=True):
            for name in definition.uses:
                if name in every and name not in names:
                    raise ProblemError(
                        f"experiment {experiment.id!r}.signals: must have {name!r} (effect "
                        f"{definition.effect.name!r} depends on it), but does "
                        f"not{nearest(name, names)}"
                    )


def with_units(
    description: ModelDescription, units: Sequence[tuple[str, str]], signals: Collection[str]
) -> ModelDescription:
    """Return the description with the units that the user gives to variables.

    Raises
    ------
    ProblemError
        If there is no variable and no signal with this name.
    """
    variables = dict(description.variables)
    for name, unit in units:
        if name in variables:
            variables[name] = replace(variables[name], unit=unit)
        elif name not in signals:
            raise ProblemError(
                f"{dotted('model', 'units', name)}: {description.file} has no variable of that "
                "name, and no experiment has a signal of that "
                f"name{nearest(name, [*variables, *signals])}"
            )
    return replace(description, variables=variables) if units else description


def check_signals(experiment: Experiment, description: ModelDescription) -> None:
    """Refuse signals whose names already have a meaning."""
    where = f"experiment {experiment.id!r}.signals"
    for given in experiment.signals:
        name = given.variable
        if name in description.variables:
            raise ProblemError(
                f"{where}.{name}: must not be the name of a variable of {description.file}, but "
                "is; choose another name, or move it to inputs if it is an input of the model"
            )
        if name in ("t", "s"):
            raise ProblemError(
                f"{where}.{name}: must not be named t or s, because in an effect t is the time and "
                "s is the signal at its site; choose another name"
            )
    refuse_repeated(where, [given.variable for given in experiment.signals])


def _check_start(description: ModelDescription, name: str, where: str, *, real: bool) -> None:
    variable = description.variable(name, where)
    if not variable.settable:
        raise ProblemError(
            f"{where}: {name!r} must be a variable whose start value can be set, but "
            f"{description.file} computes it (its causality is {variable.causality}); choose a "
            "parameter or an initial state"
        )
    if real and variable.kind != "real":
        raise ProblemError(
            f"{where}: {name!r} is estimated, so it must be a real variable, but is of type "
            f"{variable.kind}; give it as a known value in [values] instead"
        )


def _check_roles(
    experiment: Experiment, description: ModelDescription, parameters: Sequence[Parameter]
) -> None:
    """Refuse variables that are given twice, and values that do not fit the variable's type."""
    where = f"experiment {experiment.id!r}"
    targets = {p.target: p.name for p in parameters}
    driven = {given.variable for given in experiment.inputs}
    for given in experiment.inputs:
        if given.variable in targets:
            raise ProblemError(
                f"{where}.{dotted('inputs', given.variable)}: must not also be estimated, but "
                f"{dotted('parameters', targets[given.variable])} estimates it; remove one of the "
                "two"
            )
    for name, value in experiment.values:
        if name in driven:
            raise ProblemError(
                f"{where}.{dotted('values', name)}: must not also be an input of the same "
                "experiment, but is; remove one of the two"
            )
        check_value(f"{where}.{dotted('values', name)}", description.variables[name], value)


def check_value(where: str, variable: ModelVariable, value: Value) -> None:
    """Refuse a value that does not fit the type of a variable; `where` starts the message."""
    truth, text, kind = isinstance(value, bool), isinstance(value, str), variable.kind
    number = not truth and not text
    low, high, called = _whole_numbers(variable.type)
    fits = {
        "real": number,
        "integer": number and float(value).is_integer() and low <= float(value) <= high,
        "boolean": truth or (number and value in (0, 1)),
        "string": text,
    }
    if not fits.get(kind, False):
        must = {"integer": called, "boolean": "true or false", "string": "a text"}
        raise ProblemError(
            f"{where}: must be {must.get(kind, 'a number')} (the variable is of type {kind}), but "
            f"is {shown(value)}"
        )


def _whole_numbers(type_: str) -> tuple[float, float, str]:
    """Return the least and the greatest number of an FMI integer type, and a description."""
    bits = int(re.sub(r"\D", "", type_) or 64)
    most = min(bits, 53)  # not every larger integer is a float64
    if type_.startswith("U"):
        return 0.0, 2.0**most - 1, f"a whole number of {bits} bits, which is not negative"
    return -(2.0 ** (most - 1)), 2.0 ** (most - 1) - 1, f"a whole number of {bits} bits"


MOST_NAMED_INPUTS = 4
"""Largest number of inputs that a note names."""


def idle_inputs(problem: Problem, description: ModelDescription) -> dict[str, list[str]]:
    """Return the inputs of the FMU without data or a value, each with these experiments' ids."""
    targets = {p.target for p in problem.parameters if not p.auxiliary}
    found: dict[str, list[str]] = {}
    for variable in description.inputs():
        names = {variable.name, *variable.aliases}
        if variable.kind not in ("real", "integer", "boolean") or names & targets:
            continue
        for each in problem.experiments:
            if names.isdisjoint({i.variable for i in each.inputs} | dict(each.values).keys()):
                found.setdefault(variable.name, []).append(each.id)
    return found


def stays(variable: ModelVariable) -> str:
    """Return the start value of an input, with its unit."""
    return f"{variable.start or 0.0:g} {variable.unit}".strip()


def driven_or_constant(name: str) -> str:
    """Return advice on the two config keys that give an input data or a constant value."""
    data, constant = dotted("inputs", name), dotted("values", name)
    return f'{data} = "COLUMN", or {constant} = NUMBER if it is constant'


def silent_inputs(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Return the inputs without data or a value in all experiments."""
    idle, count = idle_inputs(problem, description), len(problem.experiments)
    return tuple(name for name, ids in idle.items() if len(ids) == count)


def silent_notes(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Return a note on the inputs without data or a value in all experiments, if there are any."""
    names = silent_inputs(problem, description)
    if not names:
        return ()
    named = [f"{n} ({stays(description.variables[n])})" for n in names[:MOST_NAMED_INPUTS]]
    more = f" and {len(names) - MOST_NAMED_INPUTS} more" if len(names) > MOST_NAMED_INPUTS else ""
    one = len(names) == 1
    return (
        f"input{'' if one else 's'} {', '.join(named)}{more} {'has' if one else 'have'} no data "
        f"and {'keeps its start value' if one else 'keep their start values'}; to change that, "
        f"write {driven_or_constant(names[0])}",
    )
