"""The core through ctypes: the structures of core.h and its functions."""

from __future__ import annotations

import ctypes
from ctypes import (
    POINTER,
    Array,
    Structure,
    addressof,
    byref,
    c_char,
    c_char_p,
    c_double,
    c_int,
    c_int32,
    c_int64,
    c_size_t,
    c_uint32,
    c_void_p,
)
from functools import cache
from typing import Any, Self, final

import numpy as np
import numpy.typing as npt

from workers.core.build import built
from workers.errors import ModelError

CO_SIMULATION, RUNGE_KUTTA, DORMAND_PRINCE, CVODE = range(4)
METHODS = {
    "fmu": CO_SIMULATION,
    "rk4": RUNGE_KUTTA,
    "dormand_prince": DORMAND_PRINCE,
    "cvode": CVODE,
}
TYPES = (
    "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64",
    "Boolean",
)  # fmt: skip
"""Types of numeric variables, in the order of `Fmu.get` and `Fmu.set`."""
FUNCTIONS = (
    "reset", "setup_experiment", "enter_configuration_mode", "exit_configuration_mode",
    "enter_initialization_mode", "exit_initialization_mode", "set_string", "set_time",
    "set_continuous_states", "get_continuous_states", "get_nominals", "get_derivatives",
    "get_event_indicators", "enter_event_mode", "update_discrete_states",
    "enter_continuous_time_mode", "completed_integrator_step", "do_step",
    "set_real_input_derivatives", "get_directional_derivative",
)  # fmt: skip
"""Functions of an FMU, in the order of `Fmu`."""


def _fields(kind: Any, *names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names]


class _HoldingStructure(Structure):
    """A structure that keeps references to the arrays whose addresses it contains."""

    def hold(self, kind: npt.DTypeLike | None = None, **fields: Any) -> Self:
        """Set fields to structures or to the addresses of arrays, and keep references to them.

        A NumPy array is copied if its type differs or if it is not in C order.
        """
        for name, value in fields.items():
            if isinstance(value, Structure):
                setattr(self, name, value)
            elif isinstance(value, Array):
                setattr(self, name, addressof(value))
            else:
                value = np.ascontiguousarray(value, kind)
                setattr(self, name, value.ctypes.data)
            self.held[name] = value
        return self

    @property
    def held(self) -> dict[str, Any]:
        """The referenced objects, by the names of the fields."""
        return self.__dict__.setdefault("_held", {})  # type: ignore[no-any-return]


class Variables(_HoldingStructure):
    """Variables of the columns of a row; core.h describes all these structures."""

    _fields_ = [
        *_fields(c_void_p, "reals", "elements"),
        *_fields(c_size_t, "n_reals", "n_elements"),
    ]


class Fmu(Structure):
    """An FMU instance and its functions."""

    _fields_ = [
        *_fields(c_void_p, "handle", *FUNCTIONS),
        *_fields(c_void_p * len(TYPES), "get", "set"),
        ("stop_unit", c_double),
        *_fields(c_size_t, "n_states", "n_indicators"),
        *_fields(c_int32, "version", "interpolates_inputs", "completes_steps", "eventful"),
    ]


class Experiment(_HoldingStructure):
    """Times, inputs, start values and recorded variables."""

    _fields_ = [
        ("stop", c_double),
        *_fields(Variables, "structure", "numbers"),
        *_fields(c_void_p, "strings", "texts"),
        ("n_strings", c_size_t),
        *_fields(Variables, "inputs", "continuous_inputs", "outputs"),
        *_fields(c_void_p, "times", "intervals", "values", "slopes", "jumps", "passed"),
        ("seen", Variables),
        *_fields(c_size_t, "n_times", "n_inputs", "n_outputs"),
        *_fields(c_void_p, "gather", "by_time", "row_ends", "measured", "sigmas"),
    ]


class Settings(_HoldingStructure):
    """Settings of the solver."""

    _fields_ = [
        *_fields(c_double, "step", "rtol", "atol"),
        ("atols", c_void_p),
        ("max_steps", c_int64),
        *_fields(c_double, "fmu_tolerance", "fixed"),
        ("all_steps", c_int64),
    ]


class Effects(_HoldingStructure):
    """Effects, and their coefficients at each point; without arguments, no effects.

    Attributes
    ----------
    n_states
        Number of the effects' own states.
    """

    _fields_ = _fields(c_void_p, "program", "parameters", "fastest_rates", "coefficients", "base")
    n_states = 0

    def from_point(self, first: int) -> Effects:
        """Return the effects for the points from `first` on."""
        if not self.program or first == 0:
            return self
        rows = {name: self.held[name][first:] for name in ("fastest_rates", "coefficients", "base")}
        moved = Effects.from_buffer_copy(self).hold(**rows)
        moved.n_states = self.n_states
        return moved


NO_EFFECTS = Effects()


class Batch(Structure):
    """One experiment, simulated at many points."""

    _fields_ = [
        *_fields(c_void_p, "fmu", "experiment", "settings", "effects"),
        ("method", c_int64),
        *_fields(c_size_t, "n_points", "n_values", "n_states", "largest_array"),
        *_fields(
            c_void_p, "points", "bounds", "progress", "outputs", "codes", "indices", "steps",
            "stopped_at", "cvode", "states_out",
        ),
    ]  # fmt: skip


class Cvode(Structure):
    """Objects and functions of CVODE."""

    _fields_ = _fields(
        c_void_p, "memory", "state_vector", "work_vector", "reinit", "set_tolerances",
        "set_jacobian", "set_user_data", "set_max_step", "set_stop_time", "integrate",
        "interpolate", "vector_data", "matrix_data", "y", "z", "jacobian_states",
        "jacobian_derivatives",
    )  # fmt: skip


class Range(_HoldingStructure):
    """Nominal values and bounds of perturbed variables."""

    _fields_ = [*_fields(c_void_p, "nominals", "lows", "highs"), ("n", c_size_t)]


class Linearisation(_HoldingStructure):
    """Perturbed variables, and the derivatives."""

    _fields_ = [
        ("stepping", c_int64),
        ("offsets", c_void_p),
        *_fields(c_size_t, "first_offset", "n_inputs"),
        *_fields(Range, "states", "inputs", "parameters"),
        *_fields(c_void_p, "references", "values", "effect_positions", "x", "dx", "effective"),
        *_fields(c_void_p, "A", "B", "P", "C", "D", "Q"),
    ]


class Kalman(_HoldingStructure):
    """Process noise, measurements and innovations of an extended Kalman filter."""

    _fields_ = _fields(
        c_void_p, "diffusion", "measured", "variances", "innovations", "spreads", "covariance"
    )


class Sensitivities(_HoldingStructure):
    """Parameters, their perturbed instances, and the derivatives of outputs by the parameters."""

    _fields_ = [
        ("n", c_size_t),
        *_fields(
            c_void_p, "kinds", "positions", "references", "handles", "values", "states",
            "derivatives", "outputs", "output_positions", "output_states",
        ),
        ("n_outputs", c_size_t),
        ("sensitivities", c_void_p),
    ]  # fmt: skip


class Record(_HoldingStructure):
    """A recorded simulation, and an effect at one of its outputs."""

    _fields_ = [
        *_fields(c_void_p, "times", "values", "slopes"),
        *_fields(c_size_t, "n_times", "n_inputs", "n_outputs", "column"),
        *_fields(c_void_p, "program", "coefficients"),
        *_fields(c_double, "rate", "decay"),
        *_fields(c_void_p, "outputs", "linear"),
        ("every", c_size_t),
    ]


class Pieces(_HoldingStructure):
    """A recorded simulation, and the same simulation at the pieces of its intervals."""

    _fields_ = [
        *_fields(c_void_p, "times", "lengths", "values", "slopes", "outputs", "first", "smooth"),
        *_fields(c_size_t, "n_times", "n_inputs", "n_outputs", "pieces"),
        *_fields(c_void_p, "at", "fine_values", "fine_slopes", "fine_outputs"),
    ]


def address_of(array: Any) -> int | None:
    """Return the address of a writable array; None for an empty array.

    NumPy's own function takes five times as long, which matters for short simulations.
    """
    return addressof(c_char.from_buffer(array)) if array.size else None


_P = c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "core_program": (c_void_p, [c_char_p, c_size_t, POINTER(c_char_p)]),
    "core_program_free": (None, [_P]),
    "core_simulate": (c_size_t, [_P]),
    "core_is_stiff": (c_int, [_P]),
    "core_linearise": (c_int, [_P, _P]),
    "core_filter": (c_int, [_P, _P, _P]),
    "core_sensitivities": (c_int, [_P, _P]),
    "core_is_known": (c_int, [_P, _P, c_size_t, c_uint32, _P]),
    "core_apply_to_outputs": (c_int, [_P]),
    "core_refine": (None, [_P]),
    "core_delay": (c_int64, [_P, _P, c_size_t, c_double, _P, _P]),
    "core_backlash": (c_int64, [_P, _P, c_size_t, c_double, _P, _P]),
    "core_rate_limit": (c_int64, [_P, _P, c_size_t, c_int, c_double, c_double, _P, _P]),
    "core_run_linear": (None, [_P, _P, _P, _P, _P, c_size_t, c_size_t, c_size_t]),
    "core_run_adjoint": (None, [_P, _P, _P, _P, _P, c_size_t, c_size_t, c_size_t]),
}


def load(path: str) -> Any:
    """Load a library of the core, and declare the signatures of its functions.

    Raises
    ------
    ModelError
        If the library cannot be loaded.
    """
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        raise ModelError(
            f"{path}: must be a library for this machine, but cannot be loaded ({error}); install "
            "cluster-est again"
        ) from error
    for name, (returns, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = returns, arguments
    return library


@cache
def core() -> Any:
    """Return the core's library; if necessary, the first call compiles it.

    Raises
    ------
    ModelError
        If it cannot be compiled.
    """
    return load(str(built()))


@final
class LoadedProgram:
    """Byte code of effects, loaded into the core and freed with this object.

    Parameters
    ----------
    code
        Byte code of `workers.core.assemble`.

    Raises
    ------
    ModelError
        If it is not byte code of this version.
    """

    def __init__(self, code: bytes) -> None:
        self._library = core()
        wrong = c_char_p()
        self.address: int | None = self._library.core_program(code, len(code), byref(wrong))
        if not self.address:
            said = (wrong.value or b"").decode()
            raise ModelError(f"effects: must be byte code of this version, but are {said}")

    def __del__(self) -> None:
        if getattr(self, "address", None):
            self._library.core_program_free(self.address)
            self.address = None
