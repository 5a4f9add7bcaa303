"""Definition of a benchmark system: an FMU, independent equations of the same physics, and runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = Sequence[Array | float] | Array
"""One entry for each state, input or parameter; each a number, or one number for each run."""
Equations = Callable[[Values, Values, Values], tuple[Array | float, ...]]
"""Function of states, inputs and parameters that returns rates or outputs."""

Interface = Literal["model_exchange", "co_simulation"]
Role = Literal["train", "test"]
Split = Literal["tune", "report"]


@dataclass(frozen=True)
class Run:
    """The excitation of one experiment.

    Attributes
    ----------
    waveform
        Excitation in words.
    role
        Whether it is for training or held out.
    inputs : (samples, inputs)
        Linear between the samples.
    starts
        True initial states.
    signals : (samples, signals)
        Other measured signals, which are not inputs of the FMU; linear between the samples.
    """

    waveform: str
    role: Role
    inputs: Array = field(repr=False)
    starts: Mapping[str, float]
    signals: Array = field(repr=False)


Excitation = Callable[[Array, np.random.Generator], list[Run]]
"""Function of the sampling times and a random generator; returns the runs, training runs first."""


@dataclass(frozen=True)
class System:
    """A system of the benchmark.

    Attributes
    ----------
    name
        Name of the system and of the FMU.
    interface
        The usable interface of the FMU; with co-simulation, state derivatives are not accessible.
    split
        Whether the method is tuned on the system, or only evaluated on it.
    states, inputs, outputs
        Names in the FMU, in the order of the equations.
    parameters
        The parameters to estimate and their true values, in the order of the equations.
    constants
        Known parameters, which follow those above in the equations.
    rates, readings
        Equations independent of the FMU: rates of the states, and outputs.
    interval, samples
        Sampling interval in seconds, and number of samples in a run.
    excitation
        Makes the runs.
    unknown_starts
        Unknown initial states.
    start_error
        Largest relative error of the guess of an unknown initial state.
    spreads
        Largest relative error of a parameter's start value, if 25 % would be absurd.
    signals
        Names of measured signals that are not inputs of the FMU.
    drives
        Inputs that enter only one rate, with a constant gain: (input, state).
    substeps
        Integration steps between two samples.
    """

    name: str
    split: Split
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: Mapping[str, float]
    rates: Equations
    readings: Equations
    interval: float
    samples: int
    excitation: Excitation
    interface: Interface = "model_exchange"
    constants: Mapping[str, float] = field(default_factory=dict)
    unknown_starts: tuple[str, ...] = ()
    start_error: float = 0.1
    spreads: Mapping[str, float] = field(default_factory=dict)
    signals: tuple[str, ...] = ()
    drives: tuple[tuple[str, str], ...] = ()
    substeps: int = 10

    @property
    def times(self) -> Array:
        """The times of the samples."""
        return np.asarray(self.interval * np.arange(self.samples))

    @property
    def fmu(self) -> str:
        """The file, in the folder of the example models."""
        return f"{self.name}.fmu"

    def spread(self, parameter: str) -> float:
        """Return the largest relative error of a parameter's start value."""
        return self.spreads.get(parameter, 0.25)


def measured(*places: int) -> Equations:
    """Return the readings of sensors that measure some states directly."""
    return lambda x, u, p: tuple(x[place] for place in places)


def make_run(
    waveform: str,
    role: Role,
    inputs: Sequence[Array],
    starts: Mapping[str, float],
    signals: Sequence[Array] = (),
) -> Run:
    """Return the run of one experiment, with inputs and signals given as samples."""
    columns = np.column_stack(inputs)
    others = np.column_stack(signals) if signals else np.zeros((len(columns), 0))
    return Run(waveform, role, columns, dict(starts), others)
