"""A first config as text: the model, its parameters, defaults, and experiments."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

from cluster_est.config.config_text import FILL_IN
from cluster_est.preflight.column_matches import ColumnMatch
from cluster_est.preflight.draft import (
    MOST_LISTED_VARIABLES,
    ConfigDraft,
    DraftExperiment,
    ParameterCandidate,
)
from cluster_est.preflight.table_column import TableColumn, fold
from cluster_est.preflight.table_times import DAYS_OR_SECONDS, TIME_COLUMN_NAMES
from cluster_est.problem.tables.stand_ins import written
from cluster_est.problem.tables.units import conversion, same_unit, split_unit
from cluster_est.toml import dotted, inline
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable


def open_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines of a config, from 1, that must be filled in, with their texts."""
    lines = enumerate(text.split("\n"), 1)
    return [(i, line) for i, line in lines if FILL_IN in line and line[0] != "#"]


def write(draft: ConfigDraft, folder: Path) -> str:
    """Return a draft as the text of a config in a folder, to which its paths are relative."""
    lines = [
        f"# A first config for {draft.fmu.name}, made by cluster-est init. Names on the left are",
        "# the FMU's, names on the right are columns of the tables. Next: cluster-est check",
        "",
        *_model(draft, folder),
        "",
        *_parameters(draft),
    ]
    if draft.values:
        lines += ["", "[values]"]
        lines += [f"{dotted(name)} = {inline(value)}" for name, value in draft.values.items()]
    lines += experiments(draft.runs, draft.description, folder)
    return "\n".join(_clean(line) for line in lines) + "\n"


def _model(draft: ConfigDraft, folder: Path) -> Iterator[str]:
    description = draft.description
    yield "[model]"
    yield f"fmu = {inline(relative(draft.fmu, folder))}"
    exchange = "model_exchange" in description.interfaces
    chosen = "model_exchange" if exchange else description.interfaces[0]
    yield f'interface = "{chosen}"  # {_why(description)}'
    if exchange:
        yield (
            'solver = "dormand_prince"  # adaptive; if check says that the model is stiff, use '
            '"cvode"'
        )
        return
    yield (
        "# The solver of the FMU is used; choose a step so short that a shorter one changes "
        "nothing."
    )
    step = description.fixed_internal_step or description.default_step
    said = "seconds between communication points; default: the time between measured samples"
    yield f"# step = {inline(step or 0.01)}  # {said}"


def _why(description: ModelDescription) -> str:
    """Return why an interface was chosen, for a comment."""
    if len(description.interfaces) == 1:
        return "the only interface that the FMU offers"
    return (
        f"the FMU offers {' and '.join(description.interfaces)}; with this one every effect can be "
        "tried"
    )


def _parameters(draft: ConfigDraft) -> Iterator[str]:
    yield (
        "# These parameters are estimated from all experiments together. Remove the # before "
        "values that are"
    )
    yield "# uncertain. Put a # before values that you know: then the FMU's own value is used."
    yield "[parameters]"
    if not draft.parameters:
        yield f"# {draft.fmu.name} declares no real parameter with a start value, so there is"
        yield "# nothing to estimate but the initial states; export it with tunable parameters."
    for candidate in draft.parameters[:MOST_LISTED_VARIABLES]:
        yield _parameter(candidate)
    more = len(draft.parameters) - MOST_LISTED_VARIABLES
    if more > 0:
        yield f"# and {more} more parameters, which the FMU's description lists"
    if draft.states:
        yield (
            "# Initial states: remove the # before states that are not known; each experiment gets "
            "its own value."
        )
    for state in draft.states[:MOST_LISTED_VARIABLES]:
        value = inline({"start": state.start or 0.0, "per": "experiment"})
        yield f"# {dotted(state.name)} = {value}{said(state)}"


def _parameter(candidate: ParameterCandidate) -> str:
    variable = candidate.variable
    per = {"per": candidate.per} if candidate.per else {}
    per |= {"scale": candidate.scale} if candidate.scale != "linear" else {}
    value = {"start": candidate.start, "bounds": candidate.bounds, **per}
    line = f"{dotted(variable.name)} = {inline(value)}{said(variable, candidate.origin)}"
    return f"# {line}; not estimated: {candidate.why_not}" if candidate.why_not else line


def _clean(line: str) -> str:
    """Return a line without control characters, which TOML forbids in comments."""
    return "".join(c if c >= " " and c != "\x7f" else " " for c in line)


MOST_UNMATCHED_OUTPUTS = 20
"""Largest number of outputs without a similar column that a comment names."""
MOST_PROPOSED_SIGNALS = 20
"""Largest number of columns that are proposed as signals."""


def experiments(
    runs: Sequence[DraftExperiment], description: ModelDescription, folder: Path
) -> Iterator[str]:
    """Yield the lines of all experiments of a config in a folder.

    Common keys of several experiments are written once, as defaults.
    """
    noise = _shared_noise(runs)
    bodies = [list(_body(run, noise, description)) for run in runs]
    shared = _shared(bodies)
    if shared:
        yield ""
        yield "# Defaults of all experiments; an experiment below may have its own value."
        yield "[experiment_defaults]"
        yield from shared
        bodies = [[line for line in body if line not in shared] for body in bodies]
    for run, body in zip(runs, bodies, strict=True):
        yield ""
        yield "[[experiments]]"
        yield f"id = {inline(run.id)}"
        yield from _data(run, folder)
        if run.role == "test":
            yield 'role = "test"  # held out: its errors are reported, but it is never fitted'
        if run.test is not None and run.test[1]:
            yield f"split_value = {inline(run.test[1])}"
        yield from run.lines
        yield from body


def _data(run: DraftExperiment, folder: Path) -> Iterator[str]:
    """Yield the path of an experiment's table, or those of the files of one test."""
    files = run.columns.files
    if not files:
        yield f"data = {inline(relative(run.columns.path, folder))}"
        return
    yield "# Files of one test, by their names, columns and times: each channel has its own times."
    yield f"data = {inline([relative(path, folder) for path in files])}"


def _shared(bodies: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines common to several experiments; comments only if all lines are common.

    Otherwise a comment would be separated from the lines that it describes.
    """
    if len(bodies) < 2:
        return []
    if all(body == bodies[0] for body in bodies):
        return list(bodies[0])
    return [
        line
        for line in bodies[0]
        if not line.startswith("#") and all(line in body for body in bodies)
    ]


def _body(
    run: DraftExperiment, noise: Mapping[str, float], description: ModelDescription
) -> Iterator[str]:
    """Yield the lines of an experiment about its table."""
    columns = run.columns
    yield from _reading(run)
    yield from _time(run)
    for match in run.inputs:
        yield from _input(match, columns.signals, _unusable(run, match.variable.name))
    yield from _outputs(run)
    yield from _conversions(run)
    yield from _sigmas(run, noise)
    used = {column.name for column in run.used}
    unused = [c for c in columns.signals if c.name not in used]
    if unused:
        yield f"# columns that match no variable of the FMU: {', '.join(c.name for c in unused)}"
        yield from _open_outputs(run)
        yield from _open_conversions(run, unused)
        yield from _signals(unused, description)
    if columns.unusable:
        yield f"# columns without numbers: {', '.join(columns.unusable)}"


def _reading(run: DraftExperiment) -> Iterator[str]:
    """Yield the keys for reading an experiment's file, and notes about it."""
    columns = run.columns
    for key, value in vars(columns.reading).items():
        if key == "long" and value is not None:
            yield f"long = {inline(dict(zip(('names', 'values'), value, strict=True)))}"
        elif value not in ("", None):
            yield f"{key} = {inline(value)}"
    for key, value in columns.found.items():
        if key != "long":
            guess = "  # a guess" if key == "encoding" else ""
            yield f"{key} = {inline(value)}{guess}"
    if columns.missing or run.stand_ins:
        every = ", ".join(map(written, dict.fromkeys((*columns.missing, *run.stand_ins))))
        guess = "  # a guess: probably not measured values" if run.stand_ins else ""
        yield f"missing = [{every}]{guess}"
    if run.test is not None:
        yield f"split_by = {inline(run.test[0])}"


def _signals(unused: Sequence[TableColumn], description: ModelDescription) -> Iterator[str]:
    """Yield unused columns as signals."""
    taken = {*description.variables, "t", "s"}
    yield "# Uncomment signals that may matter, such as a temperature: effects may depend on them."
    for column in unused[:MOST_PROPOSED_SIGNALS]:
        name = re.sub(r"\W+", "_", column.plain).strip("_") or "signal"
        name = f"signal_{name}" if name[0].isdigit() else name
        while name in taken:
            name += "_measured"
        taken.add(name)
        unit = f"  # [{column.unit}]" if column.unit else ""
        yield f"# {dotted('signals', name)} = {_signal(column, inline(column.name))}{unit}"
    more = len(unused) - MOST_PROPOSED_SIGNALS
    if more > 0:
        yield f"# and {more} more columns"


def _time(run: DraftExperiment) -> Iterator[str]:
    time = run.columns.time
    if run.columns.refusal:
        yield f"# check and fit refuse these times: {run.columns.refusal}"
    if time is not None:
        yield f"time = {inline(time.name)}"
        return
    why = "no column is named time"
    for name in run.columns.unusable:
        if fold(split_unit(name)[0]) in TIME_COLUMN_NAMES:
            why = (
                f"column {name!r} has no numbers; remove the row of units, or convert dates to "
                "seconds"
            )
    yield f'sample_time = "{FILL_IN}: seconds between rows"  # {why}'
    for name in run.columns.increasing[:3]:
        yield (
            f"# time = {inline(name)}  # use this instead if it is the time: it increases from row "
            "to row"
        )


def _input(match: ColumnMatch, columns: tuple[TableColumn, ...], unusable: str) -> Iterator[str]:
    variable = match.variable
    key = dotted("inputs", variable.name)
    if match.column is not None:
        value = _held(match.column, inline(match.column.name))
        why = (_why_taken(match), _why_held(match.column))
        yield f"{key} = {value}{said(variable, '; '.join(filter(None, why)))}"
    elif match.similar is not None:
        value = _held(match.similar, _guess(match.similar))
        why = (_why_held(match.similar), _choices(columns))
        yield f"{key} = {value}{said(variable, '; '.join(filter(None, why)))}"
    else:
        start = variable.start or 0.0
        kept = f"{unusable or 'no column matches it'}, so it keeps its start value {start:g}"
        yield f'# {key} = "COLUMN"{said(variable, kept)}'


def _held(column: TableColumn, name: str) -> str:
    """Return an input's column as TOML; a jumping input is held between samples."""
    return _signal(column, name, ', interpolation = "hold"' if column.is_held else "")


def _signal(column: TableColumn, name: str, more: str = "") -> str:
    """Return a signal's column as TOML, with the column of its own times."""
    if column.clock is not None:
        more += f", time = {inline(column.clock.name)}"
    return f"{{ column = {name}{more} }}" if more else name


def _why_held(column: TableColumn) -> str:
    """Return why an input is held between samples, or might be; or ""."""
    if column.jumps:
        return 'it jumps; a fit reports if the data prefer "linear"'
    if column.at_changes:
        return (
            "it seems to be recorded only when it changes; a fit reports if the data prefer "
            '"linear"'
        )
    if column.few:
        return (
            "few of its cells have a value, and straight lines join these; if it keeps each value "
            f'until the next, write {{ column = {inline(column.name)}, interpolation = "hold" }}'
        )
    return ""


def _why_taken(match: ColumnMatch) -> str:
    """Return why a column with another name is used."""
    return "the only column whose unit matches" if match.by_unit else ""


def _outputs(run: DraftExperiment) -> Iterator[str]:
    certain = [m for m in (*run.outputs, *run.further) if m.column is not None]
    for match in run.outputs:
        variable = match.variable
        key = dotted("outputs", variable.name)
        if match.column is not None:
            value = _signal(match.column, inline(match.column.name))
            yield f"{key} = {value}{said(variable, _why_taken(match))}"
        elif certain and match.similar is not None:
            value = _signal(match.similar, inline(match.similar.name))
            why_similar = "a similar name; uncomment the line if it is the right column"
            yield f"# {key} = {value}{said(variable, why_similar)}"
        elif not certain and (match.similar is not None or match is run.outputs[0]):
            value = f'"{FILL_IN}: a column"'
            if match.similar is not None:
                value = _signal(match.similar, _guess(match.similar))
            why = (_unusable(run, variable.name), _choices(run.columns.signals))
            yield f"{key} = {value}{said(variable, '; '.join(filter(None, why)))}"
    for match in run.further:
        if match.column is not None:
            key = dotted("outputs", match.variable.name)
            undeclared = said(match.variable, "not declared as an output")
            value = _signal(match.column, inline(match.column.name))
            yield f"{key} = {value}{undeclared}"
    if not certain and not run.outputs:
        yield "# The FMU has no output: give the name of a variable that it computes."
        yield f'outputs = "{FILL_IN}: {{ VARIABLE = COLUMN }}"'


def _unusable(run: DraftExperiment, name: str) -> str:
    """Return what is wrong with a column that has the name of a variable, if there is one."""
    for column, why in run.columns.unusable.items():
        if fold(split_unit(column)[0]) == fold(name):
            return f"column {column!r} {why}"
    return ""


def _open_outputs(run: DraftExperiment) -> Iterator[str]:
    """Yield outputs that may be one of the remaining columns, without a similar name."""
    certain = any(m.column is not None for m in (*run.outputs, *run.further))
    first = run.outputs[:1]
    for match in run.outputs[:MOST_UNMATCHED_OUTPUTS]:
        asked = not certain and match in first
        if match.column is None and match.similar is None and not asked:
            variable = match.variable
            why = said(variable, "no column matches it")
            yield f'# {dotted("outputs", variable.name)} = "COLUMN"{why}'


def _open_conversions(run: DraftExperiment, unused: list[TableColumn]) -> Iterator[str]:
    """Yield conversions of the remaining columns, in case one is an open variable."""
    open_ = [m.variable.unit for m in (*run.inputs, *run.outputs) if m.column is None]
    for column in unused:
        for unit in dict.fromkeys(open_):
            found = conversion(column.unit, unit) if column.unit and unit else None
            if found is not None and not same_unit(column.unit, unit):
                why = f"if its variable is in {unit}"
                yield from (f"# {line}" for line in _conversion(column, unit, why))


def _compared(run: DraftExperiment) -> list[tuple[ModelVariable, TableColumn]]:
    """Return the outputs written with a column, including a column to be confirmed."""
    certain = [(m.variable, m.column) for m in (*run.outputs, *run.further) if m.column is not None]
    return certain or [(m.variable, m.similar) for m in run.outputs if m.similar is not None]


def _shared_noise(runs: Sequence[DraftExperiment]) -> dict[str, float]:
    """Return one guess of the noise of each output if all experiments compare the same."""
    compared = [{v.name: c for v, c in _compared(run)} for run in runs]
    named = [{name: column.name for name, column in own.items()} for own in compared]
    if any(own != named[0] for own in named):
        return {}
    return {name: median(own[name].noise for own in compared) for name in named[0]} if runs else {}


GUESSED_SIGMA = (
    "the sigmas above only weight the outputs; replace them all by the noise of your sensors, then "
    "remove this line"
)
"""Comment on guessed sigmas."""


def _sigmas(run: DraftExperiment, noise: Mapping[str, float]) -> Iterator[str]:
    """Yield guesses of the noise of each output, which determine the weights of the outputs."""
    compared = _compared(run)
    guesses = [_in_unit(noise.get(v.name, c.noise), c, v) for v, c in compared]
    several = len(compared) > 1 and all(guesses)
    for (variable, _), guess in zip(compared, guesses, strict=True):
        if any(line.startswith(f"{dotted('sigma', variable.name)} =") for line in run.lines):
            continue
        line = f"{dotted('sigma', variable.name)} = {inline(guess or 0.01)}"
        why = "standard deviation of its noise, a guess"
        weighs = f"{line}  # {why}, for the weight of the output"
        yield weighs if several else f"# {line}  # {why}; give it only if you know the sensor"
    if several:
        yield f"sigma_known = false  # {GUESSED_SIGMA}"


def _in_unit(noise: float, column: TableColumn, variable: ModelVariable) -> float:
    """Return a column's noise in the unit of its variable, with two digits."""
    found = conversion(column.unit, variable.unit)
    return float(f"{noise * (1.0 if found is None else found.factor):.2g}")


def _conversions(run: DraftExperiment) -> Iterator[str]:
    """Yield lines for columns whose unit differs from that of their variable."""
    time = run.columns.time
    if time is not None and time.unit == DAYS_OR_SECONDS:
        value = inline(
            {"factor": f"{FILL_IN}: 86400 if it counts days, as Excel does, otherwise 1"}
        )
        yield f"{dotted('columns', time.name)} = {value}"
    elif run.columns.time is not None and run.columns.time.unit:
        yield from _conversion(run.columns.time, "s", "times are in seconds")
    for clock in dict.fromkeys(c.clock for c in run.used if c.clock is not None):
        if clock.unit and time is not None and clock.name != time.name:
            yield from _conversion(clock, "s", "times are in seconds")
    for variable, name in run.switches:
        why = (
            f"on and off are read as 1 and 0 {variable.unit}: give the value of {variable.name} "
            f"while {name} is on"
        )
        yield f"# {dotted('columns', name)} = {inline({'factor': 1.0})}  # {why}"
    inputs = [(m.variable, m.column or m.similar) for m in run.inputs]
    for variable, column in (*inputs, *_compared(run)):
        if column is not None and column.unit and variable.unit and not column.is_switch:
            yield from _conversion(column, variable.unit, f"{variable.name} is in {variable.unit}")


def _conversion(column: TableColumn, wanted: str, why: str) -> Iterator[str]:
    if same_unit(column.unit, wanted):
        return
    found = conversion(column.unit, wanted)
    if found is None:
        yield (
            f"# {column.name} is in {column.unit}, but {why}; if they differ, give the conversion:"
        )
        example = inline({"factor": 1.0})
        yield f"# {dotted('columns', column.name)} = {example}"
        return
    value = {"factor": found.factor} | ({"offset": found.offset} if found.offset else {})
    line = f"{dotted('columns', column.name)} = {inline(value)}"
    yield f"{line}  # from {column.unit}: {why}"


def _guess(column: TableColumn) -> str:
    return inline(f"{FILL_IN}: {column.name}?")


def _choices(columns: tuple[TableColumn, ...]) -> str:
    return "columns: " + ", ".join(column.name for column in columns[:12])


def said(variable: ModelVariable, more: str = "") -> str:
    """Return a comment with the unit and description of a variable."""
    unit = f"[{variable.unit}]" if variable.unit else ""
    parts = [" ".join(part for part in (unit, variable.description) if part), more]
    text = "; ".join(part for part in parts if part)
    return f"  # {text}" if text else ""


def relative(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, with slashes; absolute if that is not possible."""
    try:
        found = os.path.relpath(path.resolve(), folder.resolve())
    except ValueError:  # on another drive
        found = str(path.resolve())
    return found.replace(os.sep, "/")
