"""CVODE of the SUNDIALS libraries that fmpy's wheel carries, loaded when a model first needs it.

Reference: A. C. Hindmarsh et al., SUNDIALS: Suite of nonlinear and differential/algebraic equation
solvers, ACM Trans. Math. Softw. 31 (2005) 363-396, doi:10.1145/1089014.1089020.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from ctypes import CDLL, byref, c_int, c_int64, c_void_p, cast
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from workers.errors import ModelError
from workers.messages import FloatArray, IntArray

BDF, ONE_STEP = 2, 2
FIRST_DERIVATIVE_FAILED, TOO_CLOSE = -9, -27
(
    RIGHT_HAND_SIDE,
    INTERVAL,
    STATUS,
    STEPS_LEFT,
    NEXT_STOP,
    STEP_REPORTED,
    JUST_STARTED,
    EVENT_DUE,
    REPEATED_EVENTS,
) = range(9)
"""Places in `Cvode.flags`."""


class DirectionalJacobian(NamedTuple):
    """The Jacobian by the FMU's directional derivatives: (n,) references, none for differences.

    `states` and `derivatives` have the references of the states and their derivatives; `known` and
    `seed` are memory for a single state and the direction along it.
    """

    states: IntArray
    derivatives: IntArray
    known: IntArray
    seed: FloatArray

    @classmethod
    def of(cls, states: Sequence[int] = (), derivatives: Sequence[int] = ()) -> DirectionalJacobian:
        """Make one of these references."""
        return cls(
            np.array(states, np.uint32),
            np.array(derivatives, np.uint32),
            np.zeros(1, np.uint32),
            np.ones(1),
        )


class CvodeHandles(NamedTuple):
    """An integrator for compiled code: its handles, the addresses of its functions, its memory.

    `state_vector` and `work_vector` are vectors of the library around `y`, the present states, and
    `z`, for tolerances and the states at an earlier time. `time` is the present time.
    `flags` holds the address of the right-hand side that the integrator was made with (0: of none
    yet), the interval of the grid, the FMU's last status, the steps that are left, the index of
    the grid time of the next stop, and whether the FMU was told of the last step, the integrator
    has just been started, and an event is due; at last, the number of events since the last step.
    `jacobian` has the references of directional derivatives.
    """

    memory: int
    state_vector: int
    work_vector: int
    solver: int
    matrix: int
    init: int
    reinit: int
    set_tolerances: int
    set_linear_solver: int
    set_jacobian: int
    set_user_data: int
    set_max_step: int
    set_stop_time: int
    integrate: int
    interpolate: int
    vector_data: int
    matrix_data: int
    y: FloatArray
    z: FloatArray
    time: FloatArray
    flags: IntArray
    jacobian: DirectionalJacobian


_CVODE = {
    "init": "CVodeInit",
    "reinit": "CVodeReInit",
    "set_tolerances": "CVodeSVtolerances",
    "set_linear_solver": "CVodeSetLinearSolver",
    "set_jacobian": "CVodeSetJacFn",
    "set_user_data": "CVodeSetUserData",
    "set_max_step": "CVodeSetMaxStep",
    "set_stop_time": "CVodeSetStopTime",
    "integrate": "CVode",
    "interpolate": "CVodeGetDky",
}


class SundialsLibraries(NamedTuple):
    """SUNDIALS, a file for each part."""

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
        If fmpy's wheel carries none, or another version, for this platform.
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
    except Exception as error:  # fmpy raises bare exceptions for a version that it does not know
        raise ModelError(
            'model.solver: "cvode" needs the SUNDIALS 7 libraries, which the wheel of fmpy must '
            f"carry for this platform but does not ({error}); choose dormand_prince or rk4, or "
            "simulate on 64-bit Linux or Windows, or a Mac with an ARM processor"
        ) from error


class CvodeIntegrator:
    """CVODE for one number of states: backward differences, Newton's method, dense Jacobian.

    It has a context of its own, so that integrators may run in several threads. Its memory is freed
    with it.

    Raises
    ------
    ModelError
        If the libraries are missing.
    """

    def __init__(self, states: int) -> None:
        lib = libraries()
        context = c_void_p()
        lib.core["SUNContext_Create"](c_int(0), byref(context))
        _pointer(lib.core, "SUNContext_ClearErrHandlers", context)  # they write to stderr
        y, z = np.zeros(states), np.zeros(states)
        size = c_int64(states)
        vectors = [
            _pointer(lib.vector, "N_VMake_Serial", size, c_void_p(v.ctypes.data), context)
            for v in (y, z)
        ]
        matrix = _pointer(lib.matrix, "SUNDenseMatrix", size, size, context)
        solver = _pointer(lib.linear, "SUNLinSol_Dense", vectors[0], matrix, context)
        memory = _pointer(lib.cvode, "CVodeCreate", c_int(BDF), context)
        lib.cvode["CVodeSetMaxHnilWarns"](memory, c_int(-1))  # as does this, to stdout
        self.cvode = CvodeHandles(
            memory=memory.value or 0,
            state_vector=vectors[0].value or 0,
            work_vector=vectors[1].value or 0,
            solver=solver.value or 0,
            matrix=matrix.value or 0,
            vector_data=_address(lib.core, "N_VGetArrayPointer"),
            matrix_data=_address(lib.matrix, "SUNDenseMatrix_Data"),
            **{field: _address(lib.cvode, name) for field, name in _CVODE.items()},
            y=y,
            z=z,
            time=np.zeros(1),
            flags=np.zeros(9, np.int64),
            jacobian=DirectionalJacobian.of(),
        )
        freeing = weakref.finalize(
            self, _release, lib, memory, solver, matrix, vectors, context, (y, z)
        )
        freeing.atexit = False  # a thread may still be in there when the interpreter ends


def _release(
    lib: SundialsLibraries,
    memory: c_void_p,
    solver: c_void_p,
    matrix: c_void_p,
    vectors: list[c_void_p],
    context: c_void_p,
    _kept: tuple[FloatArray, ...],
) -> None:
    """Free all in the reverse order; `_kept` holds the arrays that the vectors use."""
    lib.cvode["CVodeFree"](byref(memory))
    lib.core["SUNLinSolFree"](solver)
    lib.core["SUNMatDestroy"](matrix)
    for vector in vectors:
        lib.core["N_VDestroy"](vector)
    lib.core["SUNContext_Free"](byref(context))


def _pointer(library: CDLL, name: str, *arguments: Any) -> c_void_p:
    """Call a function that returns a pointer."""
    function = library[name]  # not getattr: fmpy has declared those
    function.restype = c_void_p
    return c_void_p(function(*arguments))


def _address(library: CDLL, name: str) -> int:
    return cast(library[name], c_void_p).value or 0
