"""Addresses of the functions in an FMU's binary, for compiled loops."""

from __future__ import annotations

import ctypes
from ctypes import c_void_p
from typing import Any

import numpy as np

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.kernels.fmi.component import FmiComponent, nothing_loaded
from workers.kernels.fmi.values import TYPES
from workers.messages import Model

_REQUIRED = {
    "reset": "Reset",
    "enter_initialization_mode": "EnterInitializationMode",
    "exit_initialization_mode": "ExitInitializationMode",
    "set_string": "SetString",
    "get_directional_derivative": "GetDirectionalDerivative",
}
_IN_2 = {"setup_experiment": "SetupExperiment"}
_IN_3 = {
    "enter_configuration_mode": "EnterConfigurationMode",
    "exit_configuration_mode": "ExitConfigurationMode",
}
_MODEL_EXCHANGE = {
    "set_time": "SetTime",
    "set_continuous_states": "SetContinuousStates",
    "get_continuous_states": "GetContinuousStates",
    "get_nominals": "GetNominalsOfContinuousStates",
    "get_event_indicators": "GetEventIndicators",
    "enter_event_mode": "EnterEventMode",
    "enter_continuous_time_mode": "EnterContinuousTimeMode",
    "completed_integrator_step": "CompletedIntegratorStep",
}
_MODEL_EXCHANGE_2 = {
    "get_derivatives": "GetDerivatives",
    "update_discrete_states": "NewDiscreteStates",
}
_MODEL_EXCHANGE_3 = {
    "get_derivatives": "GetContinuousStateDerivatives",
    "update_discrete_states": "UpdateDiscreteStates",
}
_CO_SIMULATION = {"do_step": "DoStep"}
_CO_SIMULATION_2 = {"set_real_input_derivatives": "SetRealInputDerivatives"}
_OPTIONAL = {
    "set_string",
    "get_nominals",
    "get_event_indicators",
    "set_real_input_derivatives",
    "get_directional_derivative",
}
"""Fields of functions that are called only where the description promises them."""
_TYPES_IN_2 = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}
"""Names in FMI 2.0 of those types that it has."""


class FunctionTable:
    """The functions of one instance's binary.

    Parameters
    ----------
    fmu
        The instance as an object of fmpy.
    model, description
        What it was made from.
    """

    def __init__(self, fmu: Any, model: Model, description: ModelDescription) -> None:
        self._fmu, self._model, self._description = fmu, model, description

    def component(self) -> FmiComponent:
        """Return the instance with the addresses of its functions.

        Raises
        ------
        ModelError
            If a function is missing, or sizes are not as the description says.
        """
        description, exchange = self._description, self._model.interface == "model_exchange"
        version = 2 if description.version == "2.0" else 3
        used = _REQUIRED | (_IN_2 if version == 2 else _IN_3)
        if exchange:
            used |= _MODEL_EXCHANGE | (_MODEL_EXCHANGE_2 if version == 2 else _MODEL_EXCHANGE_3)
        else:
            used |= _CO_SIMULATION | (_CO_SIMULATION_2 if version == 2 else {})
        found = {field: self._address(name) for field, name in used.items()}
        absent = [used[field] for field, at in found.items() if not at and field not in _OPTIONAL]
        if absent:
            raise ModelError(
                f"{self._model.name}: its binary must have the function fmi{version}{absent[0]} "
                "but has not; export it again"
            )
        if exchange and version == 3 and not self._model.structure:
            self._check_counts()
        types = [_TYPES_IN_2.get(t, "") if version == 2 else t for t in TYPES]
        accessors = np.array(
            [[self._address(verb + t) if t else 0 for t in types] for verb in ("Get", "Set")]
        )
        component = nothing_loaded(description.version)._replace(
            handle=int(self._fmu.component),
            get_real=int(accessors[0, 0]),
            set_real=int(accessors[1, 0]),
            accessors=accessors,
            interpolates_inputs=description.interpolates_inputs,
            completes_steps=description.completes_steps,
            eventful=_has_events(description),
            n_states=len(description.states) if exchange else 0,
            n_indicators=description.event_indicators if exchange else 0,
        )
        return component._replace(**found)  # type: ignore[arg-type]

    def _check_counts(self) -> None:
        """Refuse an FMU of FMI 3.0 that is not what its description says: events would be lost."""
        described = self._description
        counted = {
            "EventIndicators": ("event indicators", described.event_indicators),
            "ContinuousStates": ("continuous states", len(described.states)),
        }
        for name, (what, expected) in counted.items():
            count = ctypes.c_size_t(expected)
            self.call(f"GetNumberOf{name}", ctypes.byref(count))
            if count.value != expected:
                raise ModelError(
                    f"{self._model.name}: its binary must have the {expected} {what} of its "
                    f"modelDescription.xml but has {count.value}; export it again"
                )

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of the FMU that fills in its last argument; nothing if it has none."""
        if address := self._address(name):
            types = [c_void_p] * (1 + len(arguments))
            types[1:-1] = [type(argument) for argument in arguments[:-1]]
            ctypes.CFUNCTYPE(ctypes.c_int, *types)(address)(self._fmu.component, *arguments)

    def _address(self, name: str) -> int:
        """Return the address of a function of the FMU; 0 if it has none."""
        whole = f"fmi{self._description.version[0]}{name}"
        function = getattr(self._fmu.dll, whole, None)
        return 0 if function is None else ctypes.cast(function, c_void_p).value or 0


def _has_events(description: ModelDescription) -> bool:
    """Return whether an input that jumps may be an event for the FMU."""
    if description.event_indicators > 0:
        return True
    return any(v.variability == "discrete" for v in description.variables.values())
