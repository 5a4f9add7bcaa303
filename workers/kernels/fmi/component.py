"""An instance of an FMU as compiled code sees it: addresses of functions, references, memory."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np

from workers.kernels.fmi.values import TYPES, VariableAccess
from workers.messages import FloatArray, IntArray
from workers.messages.types import no_watcher


class FmiComponent(NamedTuple):
    """An instance of FMI 2.0: its handle and the addresses of its functions.

    Functions that the version or the interface does not have are 0;
    `accessors` has those that get (in row 0) and set each type of variable (see
    `workers.kernels.fmi.values`). `n_states` and `n_indicators` count the FMU's own continuous
    states and event indicators; arrays of states may be longer. `interpolates_inputs` and
    `completes_steps` repeat the flags canInterpolateInputs and completedIntegratorStepNotNeeded
    (negated) of the model description. `eventful` says whether an input that jumps is an event.
    `stop_unit` says what the FMU is told of the time at which a simulation will end: nothing if it
    is negative, that time itself if it is 0, else the next multiple of it, counted from the start.
    """

    handle: int
    reset: int
    setup_experiment: int
    enter_configuration_mode: int
    exit_configuration_mode: int
    enter_initialization_mode: int
    exit_initialization_mode: int
    set_real: int
    get_real: int
    accessors: IntArray
    set_string: int
    set_time: int
    set_continuous_states: int
    get_continuous_states: int
    get_nominals: int
    get_derivatives: int
    get_event_indicators: int
    enter_event_mode: int
    update_discrete_states: int
    enter_continuous_time_mode: int
    completed_integrator_step: int
    do_step: int
    set_real_input_derivatives: int
    get_directional_derivative: int
    interpolates_inputs: bool
    completes_steps: bool
    eventful: bool
    stop_unit: float
    n_states: int
    n_indicators: int


Component3 = NamedTuple("Component3", list(FmiComponent.__annotations__.items()))  # type: ignore[misc]
"""The same of FMI 3.0, as a type of its own: loops are compiled for one version or the other."""


class StartValues(NamedTuple):
    """What is set before a simulation: variables, and `stop`, the time at which it will end.

    `structure` has structural parameters. Strings are addresses of what ends with a zero byte.
    """

    stop: float
    structure: VariableAccess
    numbers: VariableAccess
    strings: IntArray
    texts: IntArray


class VariableReferences(NamedTuple):
    """Variables that are set and got during a simulation.

    `continuous_inputs` are those inputs that may be set between events.
    """

    inputs: VariableAccess
    continuous_inputs: VariableAccess
    outputs: VariableAccess


class KernelWorkspace(NamedTuple):
    """Memory that a simulation writes to. Reused: nothing is allocated inside a loop.

    `inputs` are as measured; `effective_inputs` include the effects, and `input_slopes` are their
    slopes. `effective_parameters` are those that effects change, `base_parameters` their values
    without effects. `fastest_rate` holds that of the effects' own states.
    `stages` holds the integrator's derivatives, a row a stage; `atols` the absolute tolerances that
    hold at the moment; `next_event` the time of the next time event. `indicators` are the event
    indicators after the last step, behind an event that is being located, and of a trial.
    `info` has what FMUs say of events (see `workers.kernels.fmi.functions`), `buffer` the value of
    one variable. `squares` is described in `workers.kernels.fmi.early_end`, `progress` in
    `workers.messages.types`.
    """

    inputs: FloatArray
    effective_inputs: FloatArray
    input_slopes: FloatArray
    effective_parameters: FloatArray
    coefficients: FloatArray
    base_parameters: FloatArray
    fastest_rate: FloatArray
    derivative_orders: IntArray
    states: FloatArray
    trial: FloatArray
    stages: FloatArray
    atols: FloatArray
    next_event: FloatArray
    indicators: FloatArray
    info: IntArray
    buffer: FloatArray
    squares: FloatArray
    progress: IntArray


def workspace(
    n_inputs: int,
    n_states: int,
    n_coefficients: int = 0,
    n_parameters: int = 0,
    n_indicators: int = 0,
    buffer_size: int = 1,
    progress: IntArray | None = None,
) -> KernelWorkspace:
    """Allocate the memory for one instance.

    `n_coefficients` and `n_parameters` are those of effects; `buffer_size` is that of the largest
    array variable.
    """
    return KernelWorkspace(
        inputs=np.zeros(n_inputs),
        effective_inputs=np.zeros(n_inputs),
        input_slopes=np.zeros(n_inputs),
        effective_parameters=np.zeros(n_parameters),
        coefficients=np.zeros(n_coefficients),
        base_parameters=np.zeros(n_parameters),
        fastest_rate=np.zeros(1),
        derivative_orders=np.ones(n_inputs, np.int32),
        states=np.zeros(n_states),
        trial=np.zeros(n_states),
        stages=np.zeros((7, n_states)),
        atols=np.zeros(n_states),
        next_event=np.full(1, np.inf),
        indicators=np.zeros((3, n_indicators)),
        info=np.zeros(12, np.int32),
        buffer=np.zeros(buffer_size),
        squares=np.array([0.0, np.inf]),
        progress=no_watcher() if progress is None else progress,
    )


def nothing_loaded(version: str) -> FmiComponent:
    """Return a component whose functions must not be called, for loops that call none."""
    fields: dict[str, Any] = dict.fromkeys(FmiComponent._fields, 0)
    fields.update(accessors=np.zeros((2, len(TYPES)), np.int64))
    fields.update(interpolates_inputs=False, completes_steps=False, eventful=False)
    fields.update(stop_unit=-1.0)
    made = FmiComponent if version == "2.0" else Component3
    return cast(FmiComponent, made(**fields))
