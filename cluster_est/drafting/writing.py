"""The text of a first config, with a comment for everything that was chosen or guessed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cluster_est.config.text.unfilled import FILL_IN
from cluster_est.drafting.candidates import MOST_LISTED, ParameterCandidate
from cluster_est.drafting.draft import ConfigDraft
from cluster_est.drafting.experiment_lines import experiments, relative, said
from cluster_est.toml import dotted, inline
from workers.fmu.description import ModelDescription


@dataclass(frozen=True)
class ConfigText:
    """A first config as text.

    Attributes
    ----------
    toml
        The text.
    """

    toml: str

    @property
    def open(self) -> tuple[tuple[int, str], ...]:
        """Lines, from 1, that must be filled in, with their texts."""
        lines = enumerate(self.toml.split("\n"), 1)
        return tuple((i, line) for i, line in lines if FILL_IN in line and line[0] != "#")


def write(draft: ConfigDraft, folder: Path) -> ConfigText:
    """Write a draft for a config that will stand in a folder; its paths start from there."""
    lines = [
        f"# A first config for {draft.fmu.name}, made by cluster-est init. Names on the left are",
        "# the FMU's, names on the right are columns of the tables. Next: cluster-est check",
        "",
        *_model(draft, folder),
        "",
        *_parameters(draft),
    ]
    lines += experiments(draft.runs, draft.description, folder)
    return ConfigText("\n".join(_clean(line) for line in lines) + "\n")


def _model(draft: ConfigDraft, folder: Path) -> Iterator[str]:
    description = draft.description
    yield "[model]"
    yield f"fmu = {inline(relative(draft.fmu, folder))}"
    exchange = "model_exchange" in description.interfaces
    chosen = "model_exchange" if exchange else description.interfaces[0]
    yield f'interface = "{chosen}"  # {_why(description)}'
    if exchange:
        yield (
            'solver = "dormand_prince"  # adaptive; if check says that the model is stiff: "cvode"'
        )
        return
    yield "# its own solver; choose a step at which the result no longer depends on it"
    step = description.fixed_internal_step or description.default_step
    said = "seconds between communication points; default: from one time in the data to the next"
    yield f"# step = {inline(step or 0.01)}  # {said}"


def _why(description: ModelDescription) -> str:
    """Return why an interface was chosen, for a comment."""
    if len(description.interfaces) == 1:
        return "the only one that the FMU offers"
    return f"of {' and '.join(description.interfaces)}: every effect can be tried in it"


def _parameters(draft: ConfigDraft) -> Iterator[str]:
    yield "# What is estimated, from all experiments together. Remove the # of what you doubt, and"
    yield "# put one before what you know; its value is then the FMU's own."
    yield "[parameters]"
    if not draft.parameters:
        yield f"# {draft.fmu.name} declares no real parameter with a start value, so there is"
        yield "# nothing to estimate but the initial states; export it with tunable parameters."
    for candidate in draft.parameters[:MOST_LISTED]:
        yield _parameter(candidate)
    more = len(draft.parameters) - MOST_LISTED
    if more > 0:
        yield f"# and {more} more, which the FMU's description names"
    if draft.states:
        yield "# Initial states, where they are not known: one for each experiment."
    for state in draft.states[:MOST_LISTED]:
        value = inline({"start": state.start or 0.0, "per": "experiment"})
        yield f"# {dotted(state.name)} = {value}{said(state)}"


def _parameter(candidate: ParameterCandidate) -> str:
    variable = candidate.variable
    per = {"per": candidate.per} if candidate.per else {}
    value = {"start": candidate.start, "bounds": candidate.bounds, **per}
    line = f"{dotted(variable.name)} = {inline(value)}{said(variable, candidate.origin)}"
    return f"# {line}; not estimated: {candidate.why_not}" if candidate.why_not else line


def _clean(line: str) -> str:
    """Return a line without control characters, which TOML allows in no comment."""
    return "".join(c if c >= " " and c != "\x7f" else " " for c in line)
