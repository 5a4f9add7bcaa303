"""The curves of FMUs from elsewhere against those of fmpy: of every archive in a folder.

    python scripts/try_fmus.py FOLDER [--seconds 60] [--points 101]

Each FMU runs its default experiment with its start values, twice in a separate process, without
inputs. All of its numeric outputs are recorded, or some local variables if it has none. In
co-simulation, fmpy uses the same communication points, and in model exchange its CVODE; the
relative tolerance is 1e-8. If the two differ in co-simulation, a plain loop over fmpy's calls with
exactly the same steps decides. fmpy's own loop accumulates the steps, so that an event at a
communication point may be before or after it.

For each interface, the result is one of these: ``agrees``, with the largest difference over the
largest value of that output; ``no reset``, if only a new instance agrees, which a fit detects;
``differs``, with the number of times; ``not repeatable``, if two new processes differ, which
`check` reports too; ``refused``, with the message for a user; ``alone``, if fmpy cannot simulate
it, with its message. The counts at the end are by the folders in FOLDER.
"""

from __future__ import annotations

import argparse
import collections
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workers.errors import ModelError
from workers.fmu.description import ModelDescription, describe
from workers.fmu.variable import ModelVariable
from workers.messages import Experiment, Interface, Limits, Model, Outcome, Output, Solver, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.simulation.fixed_step import step_lengths
from workers.wire import TaskBatch

Array = NDArray[np.float64]

NUMBERS = ("real", "integer", "boolean")
MOST_OUTPUTS, MOST_LOCALS = 200, 30
CLOSE = {"co_simulation": 1e-9, "model_exchange": 1e-5}
"""Largest relative difference of curves that agree."""
TOLERANCE = 1e-8


@dataclass(frozen=True)
class Trial:
    """An FMU in one interface to simulate; `step` is the communication step."""

    file: Path
    description: ModelDescription
    interface: Interface
    outputs: tuple[str, ...]
    times: Array
    step: float


def main() -> int:
    """Compare all archives, print a line for each interface; return 1 if one differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0, help="that each trial may take")
    parser.add_argument("--points", type=int, default=101, help="at which values are compared")
    options = parser.parse_args()
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    for file in sorted(options.folder.rglob("*.fmu")):
        place = file.relative_to(options.folder)
        source = place.parts[0] if len(place.parts) > 1 else "."
        for what, found in compared(file, options.seconds, options.points):
            counts[source, found.partition(":")[0].partition(" (")[0]] += 1
            print(f"{place}  {what}  {found}", flush=True)
    print()
    for (source, found), count in sorted(counts.items()):
        print(f"{source:24} {found:24} {count:4}")
    return int(any(found.startswith("differs") for _, found in counts))


def compared(file: Path, seconds: float, points: int) -> Iterator[tuple[str, str]]:
    """Yield each interface of an archive, and its result."""
    try:
        description = describe(file.name, file.read_bytes())
    except ModelError as error:
        yield "description", f"refused: {error}"
        return
    for interface in description.interfaces:
        given = trial(file, description, interface, points)
        yield interface, compare_curves(given, seconds)


def trial(file: Path, description: ModelDescription, interface: Interface, points: int) -> Trial:
    """Return an FMU's default experiment, or a second of simulation."""
    start = description.default_start or 0.0
    stop = description.default_stop
    stop = stop if stop is not None and stop > start else start + 1.0
    times = np.linspace(start, stop, points)
    step = float(times[1] - times[0])
    if not description.variable_steps:
        own = (description.fixed_internal_step, description.default_step)
        step = next((s for s in own if s), step)
    return Trial(file, description, interface, recorded(description), times, step)


def recorded(description: ModelDescription) -> tuple[str, ...]:
    known = [v for v in description.variables.values() if v.kind in NUMBERS and v.alias_of is None]
    outputs = [v.name for v in known if v.causality == "output"]
    if outputs:
        return tuple(outputs[:MOST_OUTPUTS])

    def moves(variable: ModelVariable) -> bool:
        return variable.causality == "local" and variable.variability in ("continuous", "discrete")

    return tuple([v.name for v in known if moves(v)][:MOST_LOCALS])


def compare_curves(given: Trial, seconds: float) -> str:
    """Return the result of one trial in words."""
    if not given.outputs:
        return "refused: has no numeric output or local variable to look at"
    first, second = simulated(given, seconds)
    if isinstance(first, str):
        return f"refused: {first}"
    reference = referred(given, seconds)
    if isinstance(reference, str):
        return f"alone: fmpy says: {reference}"
    text = _difference(given, first, reference)
    if text.startswith("differs") and given.interface == "co_simulation":
        plain = stepped(given, seconds)
        if not isinstance(plain, str):
            text = f"{_difference(given, first, plain)} from a plain loop"
    if text.startswith("differs"):
        again, _ = simulated(given, seconds)
        same = not isinstance(again, str) and again.tobytes() == first.tobytes()
        return text if same else "not repeatable: two fresh processes differ"
    if isinstance(second, str):
        return f"no reset: {text}; after a reset: {second}"
    if first.tobytes() != second.tobytes():
        far = np.abs(first - second).max()
        return f"no reset: {text}; after a reset it is {far:.1e} away"
    return text


def _difference(given: Trial, found: Array, reference: Array) -> str:
    scales = np.maximum(np.abs(reference).max(axis=0), 1e-12)
    difference = np.abs(found - reference) / scales
    # differences below the absolute tolerance of both solvers are ignored
    unsaid = TOLERANCE / scales if given.interface == "model_exchange" else 0.0
    far = (~(difference <= np.maximum(CLOSE[given.interface], unsaid))).any(axis=1)
    text = f"largest difference {np.nanmax(difference):.1e} in {len(given.outputs)} outputs"
    if not far.any():
        return f"agrees: {text}"
    worst = given.outputs[int(np.nanargmax(difference.max(axis=0)))]
    return f"differs at {far.sum()} of {len(far)} times, most in {worst!r}; {text}"


def simulated(given: Trial, seconds: float) -> tuple[Array | str, Array | str]:
    """Return (times, outputs) of two consecutive simulations, or why they failed."""
    exchange = given.interface == "model_exchange"
    zero = np.zeros(len(given.times))
    outputs = tuple(Output(name, given.times, zero) for name in given.outputs)
    run = Experiment("e", given.times[0], given.times[-1], (), outputs)
    found: list[Array | str] = []
    for name in ("dormand_prince", "cvode") if exchange else ("fmu",):
        solver = Solver(name, rtol=TOLERANCE, atol=TOLERANCE if exchange else None)
        model = Model(given.file.name, given.file.read_bytes(), given.interface, solver, ())
        try:
            guard = SupervisedEvaluator(model, (run,), "w", Limits(seconds))
        except ModelError as error:
            return str(error), str(error)
        task = Task(0, 0, np.zeros(0), "trajectory")
        found = [values(guard.evaluate(TaskBatch.of([task]))[0], given.times) for _ in range(2)]
        guard.close()
        if not isinstance(found[0], str) or "stiff" not in found[0]:
            break
    return found[0], found[1]


def values(outcome: Outcome, times: Array) -> Array | str:
    if outcome.trajectory is None:
        return f"{outcome.status}: {outcome.message}"
    found: Array = outcome.trajectory.values[np.searchsorted(outcome.trajectory.times, times)]
    return found


def referred(given: Trial, seconds: float, values: dict[str, float] | None = None) -> Array | str:
    """Return (times, outputs) of fmpy from a separate process, or its message."""
    exchange = given.interface == "model_exchange"
    variables = given.description.variables
    asked: dict[str, object] = {
        "filename": str(given.file),
        "fmi_type": "ModelExchange" if exchange else "CoSimulation",
        "start_time": given.times[0],
        "stop_time": given.times[-1],
        "output_interval": float(given.times[1] - given.times[0]) if exchange else given.step,
        "relative_tolerance": TOLERANCE,
        "start_values": values or {},
        "output": list(dict.fromkeys(_whole(variables[name]) for name in given.outputs)),
    }
    columns = [(_whole(variables[name]), variables[name].element) for name in given.outputs]
    table = _answer(REFERENCE, [asked, columns], seconds)
    return table if isinstance(table, str) else on_times(table, given)


def stepped(given: Trial, seconds: float) -> Array | str:
    """Return (times, outputs) of a plain loop over fmpy's calls; only for scalars of FMI 2.0."""
    variables = [given.description.variables[name] for name in given.outputs]
    if given.description.version != "2.0":
        return "of FMI 3.0"
    lengths = step_lengths(given.times, given.description.default_step)
    outputs = [(v.reference, v.kind) for v in variables]
    asked = [str(given.file), given.times.tolist(), lengths.tolist(), outputs, TOLERANCE]
    return _answer(PLAIN_LOOP, asked, seconds)


def _answer(program: str, asked: object, seconds: float) -> Array | str:
    """Return the table that a program prints, or its message."""
    command = [sys.executable, "-c", program, json.dumps(asked)]
    try:
        ended = subprocess.run(command, capture_output=True, timeout=2.0 * seconds, check=False)
    except subprocess.TimeoutExpired:
        return "nothing in time"
    lines = ended.stdout.decode(errors="replace").splitlines()
    answers = [line for line in lines if line.startswith("[[")]
    if ended.returncode != 0 or not answers:
        said = ended.stderr.decode(errors="replace").strip().splitlines()
        return said[-1] if said else f"exit code {ended.returncode}"
    return np.array(json.loads(answers[-1]))


def _whole(variable: ModelVariable) -> str:
    """Return the name of the array that contains an element."""
    return variable.name.rpartition("[")[0] if variable.shape else variable.name


def on_times(table: Array, given: Trial) -> Array:
    """Return the reference at the compared times, interpolated as the project does."""
    columns: list[Array] = []
    for name, column in zip(given.outputs, table[:, 1:].T, strict=True):
        moves = given.description.variables[name].is_continuous
        columns.append(_between(table[:, 0], column, given.times, moves))
    return np.column_stack(columns)


def _between(known: Array, column: Array, times: Array, moves: bool) -> Array:
    if moves:
        return np.interp(times, known, column)
    nudged: Sequence[float] = times + 1e-9 * (times[1] - times[0])
    held: Array = column[np.maximum(np.searchsorted(known, nudged, side="right") - 1, 0)]
    return held


REFERENCE = """
import json, sys
import numpy as np
from fmpy import simulate_fmu
asked, columns = json.loads(sys.argv[1])
found = simulate_fmu(**asked, validate=False, record_events=False, timeout=1e9)
columns = [np.asarray(found[name], np.float64).reshape(len(found), -1)[:, element]
           for name, element in [("time", 0), *columns]]
print("\\n" + json.dumps(np.column_stack(columns).tolist()))
"""

PLAIN_LOOP = """
import json, sys
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
file, times, lengths, outputs, tolerance = json.loads(sys.argv[1])
description = read_model_description(file, validate=False)
fmu = FMU2Slave(guid=description.guid, modelIdentifier=description.coSimulation.modelIdentifier,
                unzipDirectory=extract(file), instanceName="plain")
fmu.instantiate()
fmu.setupExperiment(tolerance=tolerance, startTime=times[0])
fmu.enterInitializationMode()
fmu.exitInitializationMode()
get = {"real": fmu.getReal, "integer": fmu.getInteger, "boolean": fmu.getBoolean}
rows = []
for time, length in zip(times, lengths):
    rows.append([float(get[kind]([reference])[0]) for reference, kind in outputs])
    if length > 0.0:
        fmu.doStep(time, length)
print("\\n" + json.dumps(rows))
"""


if __name__ == "__main__":
    sys.exit(main())
