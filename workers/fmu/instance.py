"""A loaded FMU instance: fmpy loads it, the core calls its functions by address.

Its messages are collected.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import re
import sys
import threading
import weakref
from collections import deque
from collections.abc import Callable
from ctypes import c_void_p
from typing import Any

from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave

from workers.core.library import TYPES, Fmu
from workers.errors import ModelError
from workers.fmu.archive import unpack
from workers.fmu.binary_dependencies import is_about_licence, load_failure
from workers.fmu.description import ModelDescription
from workers.fmu.platforms import binary_path
from workers.fmu.process_environment import kept_signal_handlers, tell_of_first_instance
from workers.fmu.seats import Seat
from workers.messages import Model

_logs: weakref.WeakValueDictionary[str, deque[str]] = weakref.WeakValueDictionary()
_shown: set[str] = set()
"""Instances whose messages are also written to stderr."""
_STATUSES = ("ok", "warning", "discard", "error", "fatal", "pending")


def _log(_environment: object, instance: bytes, status: int, _category: bytes, text: bytes) -> None:
    """Receive a message from any instance; fmpy's proxy has one logger for all of them."""
    _append((instance or b"").decode(errors="replace"), status, text)


def open_log(name: str, log: deque[str], *, shown: bool) -> None:
    """Collect the messages of an instance in `log`, as long as `log` exists.

    If `shown`, write them to stderr too.
    """
    _logs[name] = log
    if shown:
        _shown.add(name)


def log_message_3(name: str) -> Callable[[object, int, bytes, bytes], None]:
    """Return a function that receives the messages of one instance of FMI 3.0."""
    return lambda _environment, status, _category, text: _append(name, status, text)


def _append(name: str, status: int, message: bytes) -> None:
    text = (message or b"").decode(errors="replace").strip()
    log = _logs.get(name.strip())
    if log is None and len(_logs) == 1:  # some FMUs give no instance name, or another one
        log = next(iter(_logs.values()), None)
    if log is not None and status > 0:
        log.append(text)
    if name in _shown:
        of = _STATUSES[status] if 0 <= status < len(_STATUSES) else str(status)
        sys.stderr.write(f"{of}: {text}\n")
        sys.stderr.flush()  # the next call may end the process


def make_callbacks() -> ctypes.Structure:
    """Return the callbacks of FMI 2.0, whose logger serves all instances in this process."""
    from ctypes import byref

    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )
    from fmpy.logging import addLoggerProxy

    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(_log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    addLoggerProxy(byref(callbacks))
    return callbacks  # type: ignore[no-any-return]


CALLBACKS = make_callbacks()
"""The callbacks of FMI 2.0, for all instances."""


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
"""Fields of functions that are called only if the model description declares them."""
_TYPES_IN_2 = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}
"""Names in FMI 2.0 of the types that it supports."""


class FunctionTable:
    """The functions of one instance's binary.

    Parameters
    ----------
    fmu
        The instance as an object of fmpy.
    model, description
        Its model and model description.
    """

    def __init__(self, fmu: Any, model: Model, description: ModelDescription) -> None:
        self._fmu, self._model, self._description = fmu, model, description

    def component(self) -> Fmu:
        """Return the instance with the addresses of its functions.

        Raises
        ------
        ModelError
            If a function is missing, or sizes differ from the model description.
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
                f"{self._model.name}: its binary must have the function fmi{version}{absent[0]}, "
                "but does not; export the FMU again"
            )
        if exchange and version == 3 and not self._model.structure:
            self._check_counts()
        component = Fmu(
            handle=int(self._fmu.component),
            stop_unit=-1.0,
            n_states=len(description.states) if exchange else 0,
            n_indicators=description.event_indicators if exchange else 0,
            version=version,
            interpolates_inputs=description.interpolates_inputs,
            completes_steps=description.completes_steps,
            # an input that jumps may cause an event
            eventful=description.event_indicators > 0
            or any(v.variability == "discrete" for v in description.variables.values()),
            **found,
        )
        types = [_TYPES_IN_2.get(t, "") if version == 2 else t for t in TYPES]
        component.get[:] = [self._address(f"Get{t}") if t else 0 for t in types]
        component.set[:] = [self._address(f"Set{t}") if t else 0 for t in types]
        return component

    def _check_counts(self) -> None:
        """Check the numbers of states and event indicators in FMI 3.0, so that no event is lost."""
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
                    f"modelDescription.xml, but has {count.value}; export it again"
                )

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of the FMU that writes to its last argument, unless it is missing."""
        if address := self._address(name):
            types = [c_void_p] * (1 + len(arguments))
            types[1:-1] = [type(argument) for argument in arguments[:-1]]
            ctypes.CFUNCTYPE(ctypes.c_int, *types)(address)(self._fmu.component, *arguments)

    def _address(self, name: str) -> int:
        """Return the address of a function of the FMU; 0 if it is missing."""
        whole = f"fmi{self._description.version[0]}{name}"
        function = getattr(self._fmu.dll, whole, None)
        return 0 if function is None else ctypes.cast(function, c_void_p).value or 0


_CLASSES = {
    ("2.0", "model_exchange"): FMU2Model,
    ("2.0", "co_simulation"): FMU2Slave,
    ("3.0", "model_exchange"): FMU3Model,
    ("3.0", "co_simulation"): FMU3Slave,
}
_TERMINATED, _LAST_SUCCESSFUL_TIME = 3, 2
"""Kinds of status in FMI 2.0's co-simulation."""
_NO_RESET = ctypes.CFUNCTYPE(ctypes.c_int, c_void_p)(lambda _handle: 0)
_NO_RESET_AT = ctypes.cast(_NO_RESET, c_void_p).value or 0
"""Replacement of the reset function for a new instance."""

_load_lock = threading.Lock()
_instance_count = 0
_abandoned: list[Any] = []


def instances_made() -> int:
    """Return the number of FMU instances that this process has made so far."""
    return _instance_count


class FmuInstance:
    """An instance of an FMU, which can be reset and simulated repeatedly.

    Parameters
    ----------
    model, description
        The FMU to load.

    Raises
    ------
    ModelError
        If there is no binary for this platform, or it cannot be loaded or instantiated.
    """

    def __init__(self, model: Model, description: ModelDescription) -> None:
        self._model = model
        self._description = description
        description.check_platform(model.interface)
        self._folder = unpack(model.name, model.archive, model.archive_hash)
        self.log: deque[str] = deque(maxlen=20)
        self._is_freed = self._is_used = self._is_spent = False
        self.fmu = self._load()
        """The instance as an object of fmpy."""
        self.component = self._functions.component()

    @property
    def is_new(self) -> bool:
        """Whether no simulation has used the instance; also true after it was freed."""
        return self._is_freed or not self._is_used

    def begin(self) -> Fmu:
        """Return the instance for a simulation; the first simulation needs no reset.

        The standard allows the reset of an instance that was never initialised, but hardly any tool
        uses it. Some FMUs crash in it or give wrong results afterwards.

        Raises
        ------
        ModelError
            If it was freed, and the FMU cannot be instantiated again.
        """
        if self._is_freed or self._is_spent:
            self.replace()
        component = self.component
        if self.is_new:
            component = Fmu.from_buffer_copy(component)
            component.reset = _NO_RESET_AT
        self._is_used = True
        return component

    def begin_anew(self) -> Fmu:
        """Return an instance that no simulation has used.

        Raises
        ------
        ModelError
            If the FMU cannot be instantiated again.
        """
        if self._is_used:
            self.free()
            self.replace()
        return self.begin()

    def replace(self) -> None:
        """Replace the instance by a new one, which is the only way to continue after a fatal error.

        The old instance is not freed here, because the standard forbids any further call to it. It
        is kept unless it was freed before, because it may still call its logger. If the number of
        instances is limited, it also keeps its seat, and this process makes no other instance.
        """
        if not (self._is_freed or self._is_spent):
            _abandoned.append(self.fmu)
            if self._seat is not None:
                self._seat.lose()
                self._is_spent = True  # reported by `begin`: the failure itself is reported first
                return
        self.fmu = self._load()
        self._is_freed = self._is_used = False
        self.component = self._functions.component()

    def termination_time(self) -> float | None:
        """Return the time at which the FMU terminated, after it has discarded a step.

        None if it did not terminate. This applies to FMI 2.0; in 3.0, the step itself returns it.
        """
        terminated, time = ctypes.c_int(0), ctypes.c_double(-math.inf)
        if self._description.version == "2.0":
            self._functions.call(
                "GetBooleanStatus", ctypes.c_int(_TERMINATED), ctypes.byref(terminated)
            )
        if not terminated.value:
            return None
        self._functions.call(
            "GetRealStatus", ctypes.c_int(_LAST_SUCCESSFUL_TIME), ctypes.byref(time)
        )
        return time.value

    @property
    def _functions(self) -> FunctionTable:
        return FunctionTable(self.fmu, self._model, self._description)

    def free(self) -> None:
        """Free the instance and unload its library; a second call does nothing."""
        with _load_lock:
            if not (self._is_freed or self._is_spent):
                self._is_freed = True
                with kept_signal_handlers():
                    self.fmu.freeInstance()
                if self._seat is not None:
                    self._seat.give_back()

    def _load(self) -> Any:
        """Load the FMU, after taking a seat if the number of instances is limited."""
        seats = self._model.seats
        self._seat = None if seats is None else Seat(seats, self._model.name)
        try:
            return self._load_seated()
        except BaseException:
            if self._seat is not None:
                self._seat.give_back()
            raise

    def _load_seated(self) -> Any:
        """Load the FMU with fmpy's class for its version and interface."""
        version, interface = self._description.version, self._model.interface
        model_class = _CLASSES[version, interface]
        identifier = self._description.offer(interface).identifier
        global _instance_count
        with _load_lock:
            _instance_count += 1
            name = f"{identifier}-{_instance_count}"
        tell_of_first_instance()
        open_log(name, self.log, shown=self._model.logging_on)
        try:
            # fmpy changes the working folder while it loads a library
            with _load_lock, contextlib.chdir(os.getcwd()), kept_signal_handlers():
                fmu = model_class(
                    guid=self._description.guid,
                    modelIdentifier=identifier,
                    unzipDirectory=str(self._folder),
                    instanceName=name,
                    requireFunctions=False,
                )
                self._instantiate(fmu, name)
        except Exception as error:  # fmpy raises bare exceptions here
            raise ModelError(self._load_failure(error)) from error
        return fmu

    def _instantiate(self, fmu: Any, name: str) -> None:
        version_2 = self._description.version == "2.0"
        how = {"callbacks": CALLBACKS} if version_2 else {"logMessage": log_message_3(name)}
        try:
            fmu.instantiate(loggingOn=self._model.logging_on, **how)
        except Exception:
            if not self.log and not self._description.once_per_process:
                with contextlib.suppress(Exception):  # some FMUs give the reason only with logging
                    fmu.instantiate(loggingOn=True, **how)
                    fmu.freeInstance()  # it may hold a licence
            raise

    def _load_failure(self, error: Exception) -> str:
        """Return a message that explains why the FMU could not be loaded, with advice."""
        identifier = self._description.offer(self._model.interface).identifier
        binary = self._folder / binary_path(self._description.version, identifier)
        cause = load_failure(binary, str(error))
        if cause is not None:
            return f"{self._model.name}: cannot be loaded: {cause}"
        log = f" It said: {' '.join(self.log[-1].split()).rstrip('.')}." if self.log else ""
        advice = (
            "Check that the FMU runs on this machine and that everything that it needs is installed"
        )
        if self._description.offer(self._model.interface).needs_execution_tool:
            advice += (
                f"; it needs {self._description.tool or 'the tool that exported it'} on this "
                "machine"
            )
        lacking = re.search(r"undefined symbol: (fmi\w+)", str(error))
        if lacking:
            advice = (
                f"The FMU's library lacks {lacking[1]}, which every FMU must have: export it with "
                "another version of its tool"
            )
        if any(is_about_licence(line) for line in (*self.log, str(error))):
            advice = "Get the licence that the FMU needs, or export it so that it needs none"
        return f"{self._model.name}: cannot be loaded and instantiated ({error}).{log} {advice}"
