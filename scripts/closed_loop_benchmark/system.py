"""What a system of the benchmark is: an FMU, the same physics written once more, and its runs."""

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
"""From states, inputs and parameters to rates or to outputs."""

Interface = Literal["model_exchange", "co_simulation"]
Role = Literal["train", "test"]
Split = Literal["tune", "report"]


@dataclass(frozen=True)
class Run:
    """The excitation of one experiment.

    Attributes
    ----------
    waveform
        What drives the experiment, in words.
    role
        Whether it is for training or held out.
    inputs : (samples, inputs)
        Linear between the samples.
    starts
        True initial states.
    signals : (samples, signals)
        What was measured too, but is no input of the FMU; linear between the samples.
    """

    waveform: str
    role: Role
    inputs: Array = field(repr=False)
    starts: Mapping[str, float]
    signals: Array = field(repr=False)


Excitation = Callable[[Array, np.random.Generator], list[Run]]
"""From the sampling times and a random generator to the runs, training runs first."""


@dataclass(frozen=True)
class System:
    """A system of the benchmark.

    Attributes
    ----------
    name
        Also that of the FMU.
    interface
        The interface of the FMU that may be used: with co-simulation, state derivatives are out
        of reach.
    split
        Whether the method is tuned on the system, or only reported on it.
    states, inputs, outputs
        Names in the FMU, in the order of the equations.
    parameters
        The parameters to estimate and their true values, in the order of the equations.
    constants
        Parameters that are known, appended to those above in the equations.
    rates, readings
        The equations, apart from the FMU's: rates of the states, and outputs.
    interval, samples
        Sampling interval in seconds and samples a run.
    excitation
        Makes the runs.
    unknown_starts
        Initial states that the estimation does not know.
    start_error
        Largest relative error of the guess of an unknown initial state.
    spreads
        Largest relative error of a parameter's start value, where 25 % would be absurd.
    signals
        Names of measured signals that are no inputs of the FMU.
    drives
        Inputs that enter one rate only, and there with a constant gain: (input, state).
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
    """Return the readings of sensors that show some of the states as they are."""
    return lambda x, u, p: tuple(x[place] for place in places)


def make_run(
    waveform: str,
    role: Role,
    inputs: Sequence[Array],
    starts: Mapping[str, float],
    signals: Sequence[Array] = (),
) -> Run:
    """Gather the inputs and signals of one experiment, each given as its samples."""
    columns = np.column_stack(inputs)
    others = np.column_stack(signals) if signals else np.zeros((len(columns), 0))
    return Run(waveform, role, columns, dict(starts), others)
