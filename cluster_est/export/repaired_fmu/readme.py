"""The README inside an exported FMU: what was added, on which data, with what error."""

from __future__ import annotations

from cluster_est.export.repaired_fmu.layout import WrapperLayout
from cluster_est.export.repaired_fmu.step_error import StepErrors
from cluster_est.export.repaired_model import RepairedModel
from cluster_est.export.text import describe_repair

_README = """# {name}

{file} with the estimates and effects of run {run}, made by {tool}.

## What was added

{effects}
## The data

{data}

## The error before and after

{errors}

## The communication step

{step}

## How it works

The original FMU lies unpacked in resources/original; the library in binaries/ loads it from there.
{simulation}

The wrapper's C sources are in sources/. They need no further header and are compiled with

    cc -std=c99 -O2 -ffp-contract=off -fPIC -shared -o {name}.so *.c -lm -ldl
"""
_EXCHANGE = """In co-simulation the wrapper integrates the repaired model with {solver}. In model
exchange the tool integrates: the run had a relative tolerance of {tolerance:g}, which is the FMU's
default too, and a looser one, or an output interval that inputs change within, adds an error of its
own. Delays and backlashes are sampled at completed integrator steps."""
_SIMULATION = """The original is for co-simulation, so this FMU is too; it makes the steps of the
run."""
_STEP = """In co-simulation, {sentence}.

The run took inputs as linear between their samples, or held, as its config says. Here they were
kept constant within each communication step, as most tools do, and every experiment had its own
values. Tools that set input derivatives (fmi2SetRealInputDerivatives) may take longer steps."""


def readme(layout: WrapperLayout, name: str, tool: str, step: StepErrors | None) -> str:
    """The text in Markdown.

    Parameters
    ----------
    layout
        The exported FMU.
    name, tool
        Of its library, and what made it.
    step
        What was measured of its communication step; None if that was not wanted.
    """
    repair = layout.repair
    model = repair.problem.model
    solver = "dormand_prince" if model.solver.name == "cvode" else model.solver.name
    how = (
        _EXCHANGE.format(solver=solver, tolerance=layout.tolerance)
        if layout.exchange
        else _SIMULATION
    )
    return _README.format(
        name=name,
        file=model.name,
        run=repair.run,
        tool=tool,
        effects="\n".join(f"    {line}".rstrip() for line in describe_repair(repair).split("\n")),
        data=_data(repair),
        errors=_errors(repair),
        step="It was not measured." if step is None else _step(step),
        simulation=how,
    )


def _data(repair: RepairedModel) -> str:
    lines = ["| experiment | role | from | to | outputs |", "|---|---|---|---|---|"]
    for experiment in repair.problem.experiments:
        role = "fitted" if experiment.role == "train" else "held out"
        outputs = ", ".join(
            f"{_cell(output.variable)} ({len(output.times)} samples)"
            for output in experiment.outputs
        )
        times = f"{experiment.start:.6g} s | {experiment.stop:.6g} s"
        lines.append(f"| {_cell(experiment.id)} | {role} | {times} | {outputs} |")
    return "\n".join(lines)


def _errors(repair: RepairedModel) -> str:
    if not repair.errors:
        return "Nothing was reported."
    lines = [
        f"Root mean square errors; before: {repair.without}; after: with all that is in this FMU.",
        "",
        "| experiment | role | output | unit | before | after |",
        "|---|---|---|---|---|---|",
    ]
    for error in repair.errors:
        role = "fitted" if error.role == "train" else "held out"
        sizes = f"{error.before:.4g} | {error.after:.4g}"
        named = f"{_cell(error.experiment)} | {role} | {_cell(error.output)} | {error.unit}"
        lines.append(f"| {named} | {sizes} |")
    return "\n".join(lines)


def _step(found: StepErrors) -> str:
    if found.why_not:
        return f"It was not measured, because {found.why_not}."
    names = [name for name, _ in found.reported]
    units = dict(found.units)
    heads = [f"RMSE of {_cell(n)}{f' ({units[n]})' if units.get(n) else ''}" for n in names]
    lines = [f"| step | {' | '.join(heads)} |", "|---" * (len(names) + 1) + "|"]
    rows = [(f"{step:.6g} s", dict(errors)) for step, errors in found.measured]
    rows.append(("the run", dict(found.reported)))
    lines += [f"| {head} | {' | '.join(f'{of[n]:.4g}' for n in names)} |" for head, of in rows]
    of = ", ".join(found.experiments)
    table = "\n".join([f"Over experiments {of}:", "", *lines])
    return f"{_STEP.format(sentence=found.sentence)}\n\n{table}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
