"""The next experiment as an entry of `[[experiments]]`, to paste into a config."""

from __future__ import annotations

from cluster_est.toml import inline
from workers.messages import Experiment, Input

TABLE, STEM = "TABLE.csv", "TABLE"
"""What stands in run.json for the table and its name, which the run does not know."""


def experiment_block(experiment: Experiment, data: str, name: str) -> str:
    """Return the lines of the entry.

    Parameters
    ----------
    experiment
        With its inputs, and outputs that are to be measured.
    data, name
        Path of its table from the config's folder, and what it is called.
    """
    inputs = {given.variable: _column(given) for given in experiment.inputs}
    signals = {given.variable: _column(given) for given in experiment.signals}
    lines = [
        "[[experiments]]",
        f"id = {inline(name)}",
        f"data = {inline(data)}",
        'time = "time"',
        f"inputs = {inline(inputs)}",
        f"outputs = {inline({o.variable: o.variable for o in experiment.outputs})}",
        *([f"signals = {inline(signals)}"] if signals else []),
        *([f"values = {inline(dict(experiment.values))}"] if experiment.values else []),
        *([f"group = {inline(dict(experiment.groups))}"] if experiment.groups else []),
    ]
    return "\n".join(lines) + "\n"


def _column(given: Input) -> str | dict[str, str]:
    """A column of an input as a config names it."""
    if given.interpolation == "linear":
        return given.variable
    return {"column": given.variable, "interpolation": given.interpolation}
