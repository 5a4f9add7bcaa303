"""Checks of the data: missing inputs, gaps and jumps, outliers, and weights."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.config.sections import Config
from cluster_est.preflight.column_matches import has_unit
from cluster_est.preflight.subject import CheckFinding, fault, listed, note, passed
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.sigmas import mixed_sigmas
from cluster_est.problem.tables.gaps import RecordGap, gap_findings
from cluster_est.problem.tables.jumps import (
    LEAST_NOISE_OF_RANGE,
    answers_to_inputs,
    jump_findings,
)
from cluster_est.problem.tables.sparse_inputs import few_samples, sparse_inputs
from cluster_est.problem.tables.stand_ins import stand_ins
from cluster_est.problem.thinning import IN_PARTS, looked_at_in_parts, thinned
from cluster_est.problem.variables import driven_or_constant, idle_inputs, stays
from cluster_est.statistics.noise.estimate import (
    STEP_OVER_DEVIATION,
    estimate_noise,
    quantisation_step,
)
from cluster_est.statistics.noise.outliers import isolated_outliers
from cluster_est.statistics.records import make_records
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Output

FEW_OUTLIERS = 0.01
"""Largest share of outliers among the samples; a larger share belongs to the signal."""
FEWEST_VALUES = 20
"""Smallest number of distinct values of a signal with outliers; with fewer, it has levels."""
GAP = 1.5
"""Smallest length of a gap of an input, in sampling intervals."""


def data_findings(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    """Check the data of inputs and outputs, without simulations."""
    return [
        *_readings(problem),
        *_inputs_without_data(problem, description),
        *_switches(problem, description),
        *_stand_ins(problem),
        *_gaps_of_records(problem),
        *_bridged(problem, description),
        *_sparse(problem, description),
        *_jumping(problem, description),
        *_rounded(problem),
        *(note("sigma", said, do) for said, do in mixed_sigmas(problem.experiments)),
        *_outlying(problem),
    ]


def _readings(problem: Problem) -> list[CheckFinding]:
    """Return a finding for each note on the reading of files, with the number of experiments."""
    said: dict[str, list[str]] = {}
    for table in problem.tables:
        for each in table.notes:
            said.setdefault(each, []).append(table.experiment)
    lines = []
    for each, ids in said.items():
        more = f" (and {len(ids) - 1} more experiments)" if len(ids) > 1 else ""
        lines.append(passed("reading", f"{ids[0]}{more}: {each}"))
    return lines


def _inputs_without_data(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    lines = []
    for name, ids in idle_inputs(problem, description).items():
        value = stays(description.variables[name])
        count = len(problem.experiments)
        if len(ids) < count:
            said = f"has no data in {len(ids)} of {count} experiments, where it stays at {value}"
            lines.append(passed(f"input {name}", said))
            continue
        said = f"has no data, and stays at {value}"
        do = driven_or_constant(name)
        lines.append(note(f"input {name}", said, do))
    return lines


def _gaps_of_records(problem: Problem) -> list[CheckFinding]:
    """Return a finding on the gaps of each record, with their treatment."""
    return [
        passed("gaps", said, do) if treatment == "run through" else note("gaps", said, do)
        for said, do, treatment in gap_findings(problem.gaps)
    ]


def _bridged(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    """Return a finding for each input with missing samples, with its longest gap."""
    found: dict[str, list[_Gaps]] = {}
    for each in problem.experiments:
        for given in each.inputs:
            held = given.interpolation == "hold" or description.holds(given.variable)
            few = None if held else few_samples(each, given)
            if held or (few is not None and not few.regular):  # maybe recorded only at changes
                continue
            gaps = _gaps(given.times, _rows(each, problem.gaps), each)
            if gaps is not None:
                found.setdefault(given.variable, []).append(gaps)
    do = (
        'correct the column, exclude the gap with rows or windows, or set interpolation = "hold" '
        "if the signal keeps each value until the next sample"
    )
    return [note(f"input {name}", _said(gaps), do) for name, gaps in found.items()]


def _sparse(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    """Return a finding for each linear input with much fewer samples than other signals."""
    lines = []
    for each in sparse_inputs(problem.experiments, description.holds):
        kind = passed if each.slow else note
        lines.append(kind("few samples", *each.finding(problem.columns)))
    return lines


def _stand_ins(problem: Problem) -> list[CheckFinding]:
    """Return a finding for each number in the data that is probably not a measurement."""
    return [fault("missing", said, do) for said, do in problem.data_findings]


def _switches(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    """Return a finding for each input with a unit whose column contains words such as "on"."""
    lines = {}
    for table in problem.tables:
        for key, column in table.named:
            variable = description.variables.get(key.removeprefix("inputs."))
            if column in table.switches and variable is not None and has_unit(variable):
                said = f"{column!r} is on or off, which is read as 1 and 0 {variable.unit}"
                do = f"give {dotted('columns', column)}.factor, the input's value while it is on"
                lines[variable.name] = note(f"input {variable.name}", said, do)
    return [*lines.values()]


def _outlying(problem: Problem) -> list[CheckFinding]:
    """Return a finding for each output with single samples far from their neighbours."""
    runs = [each for each in problem.experiments if each.role == "train"]
    if not isinstance(problem.cost, SumSquared):
        return []
    pairs = [(each, output) for each in runs for output in each.outputs if len(output.values)]
    lines = []
    for name in dict.fromkeys(output.variable for _, output in pairs):
        own = [(each, output) for each, output in pairs if output.variable == name]
        found = [_alone(each, output) for each, output in own]
        count, samples = sum(found), sum(len(output.values) for _, output in own)
        if 0 < count <= FEW_OUTLIERS * samples:
            said = f"{count} of {samples} samples are far from both of their neighbours"
            needs = (
                "" if all(o.has_sigma for _, o in own) else f", which needs {dotted('sigma', name)}"
            )
            do = (
                "if they are faults of the sensor, reduce their weight with cost.name = "
                f'"huber"{needs}'
            )
            lines.append(note(f"output {name}", said, do))
    return lines


def _alone(experiment: Experiment, output: Output) -> int:
    """Return the number of outliers of an output; 0 if it has few distinct values."""
    values = output.values
    if output.ordinal or len(np.unique(values)) < FEWEST_VALUES or stand_ins(values):
        return 0
    records = make_records([replace(experiment, outputs=(output,))])
    noise = max(
        float(estimate_noise(values, records, values)[0]),
        LEAST_NOISE_OF_RANGE * float(np.ptp(values)),
    )
    excepted = answers_to_inputs(experiment, output.variable)
    return int(isolated_outliers(values, noise, excepted=excepted).mask.sum())


def _jumping(problem: Problem, description: ModelDescription) -> list[CheckFinding]:
    """Return a finding for each input that jumps and is interpolated linearly."""
    return [
        note("jumps", said, remedy)
        for said, remedy in jump_findings(
            problem.experiments, description.holds, problem.columns, description.unit_of
        )
    ]


def _rounded(problem: Problem) -> list[CheckFinding]:
    """Return a finding for each output whose rounding error exceeds its sigma."""
    worst: dict[str, tuple[float, float, Experiment]] = {}
    for each in problem.experiments:
        for output in each.outputs:
            step = quantisation_step(output.values)
            times = step / STEP_OVER_DEVIATION / float(output.sigmas.min(initial=np.inf))
            # without a given sigma, nothing is known about the sensor
            if (
                output.has_sigma
                and not output.ordinal
                and times > worst.get(output.variable, (1.0,))[0]
            ):
                worst[output.variable] = times, step, each
    return [
        note(
            f"output {name}",
            f"the values in experiment {each.id} are multiples of {step:.3g}; rounding alone "
            f"causes an error of {step / STEP_OVER_DEVIATION:.3g}, which is {times:.2g} times the "
            "given sigma",
            f"set {dotted('sigma', name)} to {step / STEP_OVER_DEVIATION:.3g} or more, or measure "
            "with a finer resolution",
        )
        for name, (times, step, each) in worst.items()
    ]


def _rows(experiment: Experiment, gaps: Sequence[RecordGap]) -> FloatArray:
    """Return all measured times in the simulated interval.

    Times within gaps that are already reported are omitted.
    """
    inputs = [each.times for each in (*experiment.inputs, *experiment.signals)]
    outputs = [each.times for each in experiment.outputs]
    times = np.unique(np.concatenate([*inputs, *outputs]))
    kept = (times >= experiment.start) & (times <= experiment.stop)
    for gap in gaps:
        if gap.record == experiment.record_id:
            kept &= (times <= gap.first) | (times >= gap.last)
    return np.asarray(times[kept])


@dataclass(frozen=True)
class _Gaps:
    """The gaps of an input in one experiment.

    Attributes
    ----------
    experiment
        Id of the experiment.
    missing, rows
        Number of measured times without a sample of the input, and of all measured times.
    first, last
        Ends of the longest gap in seconds.
    """

    experiment: str
    missing: int
    rows: int
    first: float
    last: float


def _gaps(times: FloatArray, rows: FloatArray, experiment: Experiment) -> _Gaps | None:
    """Return the gaps of an input; None without gaps.

    A gap is longer than the usual interval, and other signals were measured in it. A lower sampling
    rate than that of other signals is not a gap, nor is an interval in which nothing was measured.
    """
    if len(times) < 2:
        return None
    usual = float(np.median(np.diff(times)))
    first, last = experiment.start, experiment.stop
    ends = [np.nextafter(first, -np.inf), *times.tolist(), np.nextafter(last, np.inf)]
    gaps = [
        (after - before, before, after)
        for before, after in itertools.pairwise(ends)
        if after - before > GAP * usual and np.any((rows > before) & (rows < after))
    ]
    if not gaps:
        return None
    _, before, after = max(gaps)
    missing = int(np.sum(~np.isin(rows, times)))
    return _Gaps(experiment.id, missing, len(rows), max(before, first), min(after, last))


def _said(gaps: Sequence[_Gaps]) -> str:
    """Return a sentence on the gaps of an input in all experiments."""
    worst = max(gaps, key=lambda each: each.last - each.first)
    head, *rest = gaps
    said = [f"{head.missing} of {head.rows} samples are missing in {head.experiment}"]
    said += [f"{each.missing} of {each.rows} in {each.experiment}" for each in rest]
    return (
        f"{listed(said)}, and are interpolated; the longest gap is "
        f"{worst.last - worst.first:.3g} s in {worst.experiment}, from {worst.first:.4g} to "
        f"{worst.last:.4g} s"
    )


def long_records(config: Config, problem: Problem) -> list[CheckFinding]:
    """Return a finding on the treatment of long records, if they are thinned."""
    most = config.thinning.most()
    found = thinned(problem, most)
    said = (
        f"for close-loop, sensitivity and design, {found.sentence}; close-loop uses more rows, or "
        "all of them, if thinning changes the result of the declared model"
    )
    parts = looked_at_in_parts(found.problem, most)
    if most is not None and parts:
        said += (
            f"; {len(parts)} of the records still have more than {IN_PARTS * most:,} rows: "
            "close-loop looks for effects in a part of each, either the first part or the one with "
            "the largest error"
        )
    return [passed("long records", said)] if found.is_thinner else []


def sigma_findings(config: Config, description: ModelDescription) -> list[CheckFinding]:
    """Return a finding if sigma is given for some outputs and not for others."""
    if config.cost.normalise != "sigma" or config.cost.name == "likelihood":
        return []
    given: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for each in config.experiments:
        for name in each.outputs:
            (given if name in each.sigma else missing).setdefault(name, []).append(each.id)
    if not given:
        return []
    lines = []
    for name, ids in missing.items():
        variable = description.variables.get(name)
        unit = f" {variable.unit}" if variable is not None and variable.unit else ""
        where = f"{listed(list(given))}, but not for {name}"
        if name in given:
            where = f"{name} in {_named(given[name])}, but not in {_named(ids)}"
        said = f"sigma is given for {where}, where 1{unit} is used instead"
        key = dotted("sigma", name)
        do = f"give {key} = NUMBER, the standard deviation of the noise, or give no sigma at all"
        lines.append(note("sigma", said, do))
    return lines


def _named(ids: Sequence[str]) -> str:
    return f"experiment{'s' if len(ids) > 1 else ''} {listed(ids)}"
