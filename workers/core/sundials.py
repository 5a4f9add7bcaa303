"""CVODE of the SUNDIALS libraries in fmpy's wheel, loaded when a model first needs it.

Reference: A. C. Hindmarsh et al., SUNDIALS: Suite of nonlinear and differential/algebraic equation
solvers, ACM Trans. Math. Softw. 31 (2005) 363-396, doi:10.1145/1089014.1089020.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from ctypes import CDLL, addressof, byref, c_double, c_int, c_int64, c_void_p, cast
from functools import cache
from typing import Any, NamedTuple, final

import numpy as np

from workers.core.library import Cvode, core
from workers.errors import ModelError
from workers.messages import FloatArray, IntArray

BDF = 2
_FUNCTIONS = {
    "reinit": "CVodeReInit",
    "set_tolerances": "CVodeSVtolerances",
    "set_jacobian": "CVodeSetJacFn",
    "set_user_data": "CVodeSetUserData",
    "set_max_step": "CVodeSetMaxStep",
    "set_stop_time": "CVodeSetStopTime",
    "integrate": "CVode",
    "interpolate": "CVodeGetDky",
}


class SundialsLibraries(NamedTuple):
    """The libraries of SUNDIALS."""

    core: CDLL
    vector: CDLL
    matrix: CDLL
    linear: CDLL
    cvode: CDLL


@cache
def libraries() -> SundialsLibraries:
    """Load SUNDIALS.

    Raises
    ------
    ModelError
        If fmpy's wheel has no SUNDIALS, or another version, for this platform.
    """
    try:
        from fmpy.sundials import libraries as found

        return SundialsLibraries(
            found.sundials_core,
            found.sundials_nvecserial,
            found.sundials_sunmatrixdense,
            found.sundials_sunlinsoldense,
            found.sundials_cvode,
        )
    except Exception as error:  # fmpy raises bare exceptions for an unknown version
        raise ModelError(
            'model.solver: "cvode" needs the SUNDIALS 7 libraries, but the installed fmpy does '
            f"not include them for this platform ({error}); choose dormand_prince or rk4, or "
            "simulate on 64-bit Linux or Windows, or on a Mac with an ARM processor"
        ) from error


@final
class CvodeIntegrator:
    """CVODE for a given number of states: BDF, Newton's method, dense Jacobian.

    Each integrator has its own context, so several integrators may run in different threads. One
    integrator must not run in two threads at a time. Its memory is freed with this object.

    Parameters
    ----------
    states
        Number of states.

    Raises
    ------
    ModelError
        If the libraries are missing.
    """

    def __init__(self, states: int) -> None:
        lib = libraries()
        context, size = c_void_p(), c_int64(states)
        lib.core["SUNContext_Create"](c_int(0), byref(context))
        _pointer(lib.core, "SUNContext_ClearErrHandlers", context)  # the handlers write to stderr
        y, z = np.zeros(states), np.zeros(states)
        vectors = [
            _pointer(lib.vector, "N_VMake_Serial", size, c_void_p(v.ctypes.data), context)
            for v in (y, z)
        ]
        matrix = _pointer(lib.matrix, "SUNDenseMatrix", size, size, context)
        solver = _pointer(lib.linear, "SUNLinSol_Dense", vectors[0], matrix, context)
        memory = _pointer(lib.cvode, "CVodeCreate", c_int(BDF), context)
        lib.cvode["CVodeSetMaxHnilWarns"](memory, c_int(-1))  # the warning is written to stdout
        at = cast(core().core_right_hand_side, c_void_p)
        lib.cvode["CVodeInit"](memory, at, c_double(0.0), vectors[0])
        lib.cvode["CVodeSetLinearSolver"](memory, solver, matrix)
        self._structure = Cvode(
            memory=memory.value,
            state_vector=vectors[0].value,
            work_vector=vectors[1].value,
            vector_data=_address(lib.core, "N_VGetArrayPointer"),
            matrix_data=_address(lib.matrix, "SUNDenseMatrix_Data"),
            y=y.ctypes.data,
            z=z.ctypes.data,
            **{field: _address(lib.cvode, name) for field, name in _FUNCTIONS.items()},
        )
        self._references: tuple[IntArray, ...] = ()
        freeing = weakref.finalize(
            self, _release, lib, memory, solver, matrix, vectors, context, (y, z)
        )
        freeing.atexit = False  # a thread may still use it when the interpreter exits

    @property
    def address(self) -> int:
        """Address of its structure, for a batch."""
        return addressof(self._structure)

    def use_jacobian(self, states: Sequence[int] = (), derivatives: Sequence[int] = ()) -> None:
        """Take the Jacobian from the FMU's directional derivatives if no effects act.

        Without references, the Jacobian is computed by finite differences.
        """
        self._references = tuple(np.array(r, np.uint32) for r in (states, derivatives))
        used = [array.ctypes.data if len(array) else None for array in self._references]
        self._structure.jacobian_states, self._structure.jacobian_derivatives = used


def _release(
    lib: SundialsLibraries,
    memory: c_void_p,
    solver: c_void_p,
    matrix: c_void_p,
    vectors: list[c_void_p],
    context: c_void_p,
    _kept: tuple[FloatArray, ...],
) -> None:
    """Free all objects in reverse order; `_kept` holds the arrays that the vectors use."""
    lib.cvode["CVodeFree"](byref(memory))
    lib.core["SUNLinSolFree"](solver)
    lib.core["SUNMatDestroy"](matrix)
    for vector in vectors:
        lib.core["N_VDestroy"](vector)
    lib.core["SUNContext_Free"](byref(context))


def _pointer(library: CDLL, name: str, *arguments: Any) -> c_void_p:
    """Call a function that returns a pointer."""
    function = library[name]  # not getattr: fmpy declares other signatures for those
    function.restype = c_void_p
    return c_void_p(function(*arguments))


def _address(library: CDLL, name: str) -> int:
    return cast(library[name], c_void_p).value or 0
