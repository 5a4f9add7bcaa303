"""An instance of an FMU as compiled code sees it: addresses of functions, references, memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from workers.kernels.values import Access, Cells, cells
from workers.messages import FloatArray, IntArray


class Component(NamedTuple):
    """An instance of an FMU: its handle and the addresses of its functions.

    `version` is 2 or 3. Functions that the version or the interface does not have are 0; `getters`
    and `setters` have one for each type of variable (see `workers.kernels.values`). `n_states` and
    `n_indicators` count the FMU's own continuous states and event indicators; arrays of states may
    be longer. `interpolates_inputs` and `completes_steps` repeat the flags canInterpolateInputs and
    completedIntegratorStepNotNeeded (negated) of the model description. `eventful` says whether an
    input that jumps is an event.
    """

    handle: int
    version: int
    reset: int
    setup_experiment: int
    enter_configuration_mode: int
    exit_configuration_mode: int
    enter_initialization_mode: int
    exit_initialization_mode: int
    getters: tuple[int, ...]
    setters: tuple[int, ...]
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
    n_states: int
    n_indicators: int


class References(NamedTuple):
    """Where the numbers of a simulation go in the FMU, and where they come from.

    `starts` are written before initialisation, `structure` (structural parameters) and strings
    before that; strings are addresses of what ends with a zero byte. `moving` are those inputs that
    may be set between events.
    """

    structure: Access
    starts: Access
    strings: IntArray
    texts: IntArray
    inputs: Access
    moving: Access
    outputs: Access


class Workspace(NamedTuple):
    """Memory that a simulation writes to. Reused: nothing is allocated inside a loop.

    `inputs` are as measured; `edited` what effects make of them, `slopes` how fast those change,
    `varied` the parameters that effects vary, `counts` the substeps of the effects' own states.
    `stages` holds the integrator's derivatives, a row a stage; `atols` the absolute tolerances that
    hold at the moment. `signs` are the event indicators after the last step, `indicators` those of
    a trial, `highs` those behind an event that is being located; `next_event` is the time of the
    next time event. `event_info` is fmi2EventInfo: five int32, four bytes of padding and a float64
    (`event_time`); `bits` are FMI 3.0's booleans; `cells` holds the value of one variable.
    """

    inputs: FloatArray
    edited: FloatArray
    slopes: FloatArray
    varied: FloatArray
    coefficients: FloatArray
    base: FloatArray
    counts: IntArray
    orders: IntArray
    states: FloatArray
    trial: FloatArray
    stages: FloatArray
    atols: FloatArray
    signs: FloatArray
    indicators: FloatArray
    highs: FloatArray
    next_event: FloatArray
    flags: IntArray
    event_info: IntArray
    event_time: FloatArray
    bits: IntArray
    cells: Cells


def workspace(
    n_inputs: int,
    n_states: int,
    n_coefficients: int = 0,
    n_parameters: int = 0,
    n_indicators: int = 0,
    n_cells: int = 1,
) -> Workspace:
    """Allocate the memory for one instance.

    `n_coefficients` and `n_parameters` are those of effects; `n_cells` is the size of the largest
    array variable.
    """
    event_info = np.zeros(8, np.int32)
    return Workspace(
        inputs=np.zeros(n_inputs),
        edited=np.zeros(n_inputs),
        slopes=np.zeros(n_inputs),
        varied=np.zeros(n_parameters),
        coefficients=np.zeros(n_coefficients),
        base=np.zeros(n_parameters),
        counts=np.ones(1, np.int64),
        orders=np.ones(n_inputs, np.int32),
        states=np.zeros(n_states),
        trial=np.zeros(n_states),
        stages=np.zeros((7, n_states)),
        atols=np.zeros(n_states),
        signs=np.zeros(n_indicators),
        indicators=np.zeros(n_indicators),
        highs=np.zeros(n_indicators),
        next_event=np.full(1, np.inf),
        flags=np.zeros(2, np.int32),
        event_info=event_info,
        event_time=event_info.view(np.float64)[3:],
        bits=np.zeros(8, np.uint8),
        cells=cells(n_cells),
    )
