"""One loaded, instantiated FMU: fmpy loads it, compiled loops call it by address."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading
import weakref
from collections import deque
from collections.abc import Iterator
from ctypes import c_void_p

from fmpy.fmi2 import FMU2Model, FMU2Slave

from workers.archive import unpack
from workers.description import PLATFORM, Description
from workers.errors import ModelError
from workers.kernels.fmi2 import Component
from workers.messages import Model

_ONLY_MODEL_EXCHANGE = {
    "set_time": "fmi2SetTime",
    "set_continuous_states": "fmi2SetContinuousStates",
    "get_continuous_states": "fmi2GetContinuousStates",
    "get_derivatives": "fmi2GetDerivatives",
    "new_discrete_states": "fmi2NewDiscreteStates",
    "enter_continuous_time_mode": "fmi2EnterContinuousTimeMode",
    "completed_integrator_step": "fmi2CompletedIntegratorStep",
}
_ONLY_CO_SIMULATION = {
    "do_step": "fmi2DoStep",
    "set_real_input_derivatives": "fmi2SetRealInputDerivatives",
}
_BOTH = {
    "reset": "fmi2Reset",
    "setup_experiment": "fmi2SetupExperiment",
    "enter_initialization_mode": "fmi2EnterInitializationMode",
    "exit_initialization_mode": "fmi2ExitInitializationMode",
    "set_real": "fmi2SetReal",
    "set_integer": "fmi2SetInteger",
    "set_boolean": "fmi2SetBoolean",
    "get_real": "fmi2GetReal",
}

_loading = threading.Lock()
_made = 0


def instances() -> int:
    """How many instances of FMUs this process has made so far."""
    return _made


class Instance:
    """An instance of an FMU, ready to be reset and simulated again and again.

    Parameters
    ----------
    model, description
        What to load.

    Raises
    ------
    ModelError
        If there is no binary for this platform, or it cannot be loaded or instantiated.
    """

    def __init__(self, model: Model, description: Description) -> None:
        self._model = model
        self._description = description
        _check_platform(description)
        self._folder = unpack(model.name, model.archive, model.archive_hash)
        self.log: deque[str] = deque(maxlen=20)
        self._freed = False
        self._fmu = self._load()
        self.component = self._addresses()

    def renew(self) -> None:
        """Replace the instance by a fresh one: all that is left after a fatal error.

        The old one is not freed, because the standard forbids any further call to it.
        """
        self._fmu = self._load()
        self.component = self._addresses()

    def free(self) -> None:
        """Free the instance and unload its library. Again does nothing: it would be freed twice."""
        with _loading:
            if not self._freed:
                self._freed = True
                self._fmu.freeInstance()

    def _load(self) -> FMU2Model | FMU2Slave:
        raw = self._description.raw
        exchange = self._model.interface == "model_exchange"
        make = FMU2Model if exchange else FMU2Slave
        interface = raw.modelExchange if exchange else raw.coSimulation
        global _made
        with _loading:
            _made += 1
            name = f"{interface.modelIdentifier}-{_made}"
        _logs[name] = self.log
        if self._model.talks:
            _talking.add(name)
        try:
            with _loading, _same_folder():
                fmu = make(
                    guid=raw.guid,
                    modelIdentifier=interface.modelIdentifier,
                    unzipDirectory=str(self._folder),
                    instanceName=name,
                )
                fmu.instantiate(callbacks=_callbacks, loggingOn=self._model.talks)
        except Exception as error:  # fmpy raises bare exceptions here
            said = f" It said: {self.log[-1].rstrip('.')}." if self.log else ""
            raise ModelError(
                f"{self._model.name}: cannot be loaded and instantiated ({error}).{said} "
                "Check that it runs on this machine and that everything it needs is installed"
            ) from error
        return fmu

    def _addresses(self) -> Component:
        exchange = self._model.interface == "model_exchange"
        used = _BOTH | (_ONLY_MODEL_EXCHANGE if exchange else _ONLY_CO_SIMULATION)
        unused = _ONLY_CO_SIMULATION if exchange else _ONLY_MODEL_EXCHANGE
        handle: int = self._fmu.component
        return Component(
            handle=int(handle),
            interpolates_inputs=self._description.interpolates_inputs,
            completes_steps=self._description.completes_steps,
            n_states=len(self._description.states) if exchange else 0,
            **{field: _address(self._fmu.dll, name) for field, name in used.items()},
            **dict.fromkeys(unused, 0),
        )


@contextlib.contextmanager
def _same_folder() -> Iterator[None]:
    """Come back to the working folder, which fmpy leaves while it loads a library."""
    before = os.getcwd()
    try:
        yield
    finally:
        os.chdir(before)


def _address(library: ctypes.CDLL, name: str) -> int:
    return ctypes.cast(getattr(library, name), c_void_p).value or 0


def _check_platform(description: Description) -> None:
    if PLATFORM not in description.platforms:
        there = ", ".join(description.platforms) or "no platform at all"
        raise ModelError(
            f"{description.file}: must have a binary for {PLATFORM}, this machine's platform, but "
            f"has one for {there}; export it for {PLATFORM}"
        )


_logs: weakref.WeakValueDictionary[str, deque[str]] = weakref.WeakValueDictionary()
_talking: set[str] = set()
"""Instances whose messages are shown."""
_STATUSES = ("ok", "warning", "discard", "error", "fatal", "pending")


def _log(environment: object, instance: bytes, status: int, category: bytes, text: bytes) -> None:
    """Receive a message from any instance; fmpy's proxy knows one logger for all of them."""
    name, said = (each.decode(errors="replace").strip() for each in (instance or b"", text or b""))
    log = _logs.get(name)
    if log is not None and status > 0:
        log.append(said)
    if name in _talking:
        of = _STATUSES[status] if 0 <= status < len(_STATUSES) else str(status)
        sys.stderr.write(f"{of}: {said}\n")
        sys.stderr.flush()  # the next call may end the process


def _make_callbacks() -> ctypes.Structure:
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


_callbacks = _make_callbacks()
