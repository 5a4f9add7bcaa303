"""The checked problem, from a config or from an FMU alone, and the time for the checks."""

from __future__ import annotations

import enum
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from cluster_est.errors import ModelError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results.output_errors import Simulation
from workers.evaluate import FmuProbe
from workers.fmu.description import ModelDescription, describe
from workers.fmu.variable import ModelVariable
from workers.messages import Experiment, FloatArray, Interface, Model, Output, ResetPolicy, Solver
from workers.process.trial import NoAnswer, ProbeBench


class CheckVerdict(enum.StrEnum):
    """The result of a check, as it is printed."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"
    NOT_DONE = "not done"


@dataclass(frozen=True)
class CheckFinding:
    """The result of one check.

    Attributes
    ----------
    verdict
        A problem prevents a correct fit; a note should be considered.
    check
        Name of the check.
    found
        Its result, in numbers.
    do
        Advice, with the key of the config; empty if nothing needs to be done.
    """

    verdict: CheckVerdict
    check: str
    found: str
    do: str = ""


passed, note = partial(CheckFinding, CheckVerdict.OK), partial(CheckFinding, CheckVerdict.NOTE)
fault = partial(CheckFinding, CheckVerdict.PROBLEM)
not_done = partial(CheckFinding, CheckVerdict.NOT_DONE)
"""Each takes the name of the check, its result and optionally the advice."""


@dataclass(frozen=True)
class CheckPage:
    """All results of a preflight.

    Attributes
    ----------
    loads
        True if the FMU can be simulated at all.
    simulations
        Simulations of the experiments at the start values, as far as there was time.
    """

    findings: tuple[CheckFinding, ...]
    simulations: tuple[Simulation, ...]
    loads: bool = True

    @property
    def good(self) -> bool:
        """True if there are no problems."""
        return not any(each.verdict is CheckVerdict.PROBLEM for each in self.findings)


MOST_LISTED_TEXTS = 5


def listed(texts: Sequence[str]) -> str:
    """Return the first texts of a list in one line, and the number of the others."""
    more = len(texts) - MOST_LISTED_TEXTS
    return ", ".join(texts[:MOST_LISTED_TEXTS]) + (f" and {more} more" if more > 0 else "")


LEAST_PROBE_SECONDS = 0.2
"""Seconds that must remain to run a probe."""


PROBE_SHARE_OF_TIME = 1.0 / 3.0
"""Share of the remaining time that a probe may take if this exceeds its need. So more time gives
every check more time."""


@dataclass
class TimeBudget:
    """Time shared by all checks."""

    seconds: float
    begun: float

    @classmethod
    def of(cls, seconds: float) -> TimeBudget:
        """Start a budget now."""
        return cls(seconds, time.monotonic())

    @property
    def left(self) -> float:
        """Remaining seconds."""
        return self.begun + self.seconds - time.monotonic()


@dataclass(frozen=True)
class CheckSubject:
    """A problem with a process in which its FMU is tested.

    Attributes
    ----------
    in_process, workers
        Whether the executor of the config runs simulations in this process, and its workers.
    growth
        Bytes after which its processes are replaced.
    instances
        Largest number of instances of the FMU at once; None for no limit.
    simulation_seconds
        Duration of the first simulation of `experiment`.
    experiment
        Index of the simulated experiment.
    reset_policy
        Reset policy of its simulations, once it is known.
    repeats
        True if a simulation is repeatable, so that small differences are meaningful.
    declared
        True if a config declares the parameters to be estimated.
    trajectory : (times, outputs)
        Trajectory of the experiment in a separate process, if known.
    share
        Share of the remaining time that a probe may take if this exceeds its need.
    """

    problem: Problem
    description: ModelDescription
    bench: ProbeBench
    budget: TimeBudget
    in_process: bool = True
    workers: int | None = None
    growth: float = 256.0 * 2**20
    instances: int | None = None
    simulation_seconds: float = 0.0
    experiment: int = 0
    reset_policy: ResetPolicy = "reset"
    repeats: bool = True
    declared: bool = True
    trajectory: FloatArray | None = None
    share: float = PROBE_SHARE_OF_TIME

    @property
    def probe_arguments(self) -> tuple[int, FloatArray, ResetPolicy]:
        """The first arguments of a probe: experiment, values and reset policy."""
        return self.experiment, self.start, self.reset_policy

    @cached_property
    def space(self) -> SearchSpace:
        return make_space(self.problem, tuple(range(len(self.problem.experiments))))

    @cached_property
    def start(self) -> FloatArray:
        """Start values of the model's parameters in the experiment, (values,)."""
        return self.at(self.space.start)

    def at(self, x: FloatArray) -> FloatArray:
        """Return the values of the model's parameters at a point of the space."""
        count = len(self.problem.model.parameters)
        return np.ascontiguousarray(self.space.physical(x)[self.experiment, :count])

    def ask(self, probe: FmuProbe, simulations: int, most: float = 2.0) -> Any:
        """Run a probe if there is time for that many simulations, else return `NoAnswer`."""
        left = self.budget.left
        needed = simulations * self.simulation_seconds
        if left < max(LEAST_PROBE_SECONDS, needed):
            return NoAnswer(
                f"it would take about {max(needed, LEAST_PROBE_SECONDS):.2g} s", late=True
            )
        return self.bench.ask(probe, min(left, max(most, 3.0 * needed, self.share * left)))


def unanswered(check: str, stopped: NoAnswer) -> CheckFinding:
    """Return the finding of a check without an answer."""
    if stopped.late:
        more = "give it more time with --seconds"
        return not_done(check, f"too little time: {stopped.message}", more)
    return note(check, f"could not be determined: {stopped.message}")


MOST_CHECKED_PARAMETERS, MOST_CHECKED_OUTPUTS = 12, 50
NUMBER_OF_CHECKED_TIMES = 101
DEFAULT_STOP = 1.0
"""Seconds, if the FMU declares no stop time."""


def bare_problem(path: Path) -> Problem:
    """Return a problem for a check of an FMU alone: all outputs, and its first real parameters.

    Raises
    ------
    ModelError
        If it cannot be read, or there is nothing to record.
    """
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read ({error.strerror}); check the path") from error
    description = describe(path.name, archive)
    interface: Interface = description.interfaces[0]
    exchange = interface == "model_exchange"
    parameters = tuple(_parameter(v) for v in _parameters(description))
    solver = Solver("dormand_prince" if exchange else "fmu")
    model = Model(path.name, archive, interface, solver, tuple(p.name for p in parameters))
    return Problem(model, parameters, (_experiment(description),))


def _parameters(description: ModelDescription) -> list[ModelVariable]:
    found = [
        v
        for v in description.variables.values()
        if v.causality == "parameter" and v.kind == "real" and v.settable and v.start is not None
    ]
    constants = {v.name for v in description.variables.values() if v.variability == "constant"}
    own = [v for v in found if v.alias_of is None and not v.is_tool_setting]
    once = {v.aliases or (v.name,): v for v in reversed(own)}  # the first of several aliases
    kept = [v for v in own if once[v.aliases or (v.name,)] is v]
    return [v for v in kept if constants.isdisjoint(v.aliases)][:MOST_CHECKED_PARAMETERS]


def _parameter(variable: ModelVariable) -> Parameter:
    return Parameter(variable.name, variable.start or 0.0)


def _experiment(description: ModelDescription) -> Experiment:
    names = dict.fromkeys([*description.outputs, *description.states])
    numbers = [n for n in names if description.variables[n].is_computed]
    numbers = numbers or _moving(description)
    if not numbers:
        raise ModelError(
            f"{description.file}: must have an output, a state or another number that changes, so "
            "that simulations can be compared, but has none; name what is measured in a config"
        )
    start = description.default_start or 0.0
    stop = description.default_stop
    stop = start + DEFAULT_STOP if stop is None or not stop > start else stop
    times = np.linspace(start, stop, NUMBER_OF_CHECKED_TIMES, dtype=np.float64)
    step = description.default_step
    if not description.variable_steps and step:
        count = max(1, math.floor((stop - start) / step + 1e-9))
        times = np.asarray(start + step * np.arange(1 + count), np.float64)
        stop = float(times[-1])
    nothing = np.zeros(len(times))
    outputs = tuple(Output(name, times, nothing) for name in numbers[:MOST_CHECKED_OUTPUTS])
    return Experiment("default", start, stop, (), outputs)


def _moving(description: ModelDescription) -> list[str]:
    """Return computed variables of an FMU that are not outputs and that may change."""
    moves = ("continuous", "discrete")
    own = [v for v in description.variables.values() if v.alias_of is None and v.is_computed]
    return [v.name for v in own if v.variability in moves and not v.is_tool_setting]
