"""The arguments of a numba loop as what the core takes, to compare the two."""

from __future__ import annotations

import ctypes
from ctypes import addressof
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workers.core import library as c
from workers.core.sundials import CvodeIntegrator
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import FmiComponent


@dataclass
class CoreBatch:
    """Structures of a batch, with the arrays that they point to."""

    batch: c.Batch
    indices: np.ndarray
    kept: list[Any] = field(default_factory=list)

    @property
    def address(self) -> int:
        return addressof(self.batch)


def at(kept, array, kind=None):
    """The address of an array, which is kept."""
    found = np.ascontiguousarray(array, kind)
    kept.append(found)
    return found.ctypes.data


def variables(kept, access):
    return c.Variables(
        at(kept, access.reals, np.uint32), at(kept, access.elements, np.int64),
        len(access.reals), len(access.elements),
    )  # fmt: skip


def fmu(component):
    own = c.Fmu(**{n: getattr(component, n, 0) or None for n in ("handle", *c.FUNCTIONS)})
    own.get[:] = [int(a) or None for a in component.accessors[0]]
    own.set[:] = [int(a) or None for a in component.accessors[1]]
    own.stop_unit = component.stop_unit
    own.n_states, own.n_indicators = component.n_states, component.n_indicators
    own.version = 2 if isinstance(component, FmiComponent) else 3
    own.interpolates_inputs = component.interpolates_inputs
    own.completes_steps, own.eventful = component.completes_steps, component.eventful
    return own


def experiment(kept, a):
    grid, starts, references = a.grid, a.starts, a.references
    return c.Experiment(
        starts.stop, variables(kept, starts.structure), variables(kept, starts.numbers),
        at(kept, starts.strings, np.uint32), at(kept, starts.texts, np.int64), len(starts.strings),
        variables(kept, references.inputs), variables(kept, references.continuous_inputs),
        variables(kept, references.outputs), at(kept, grid.times, float),
        at(kept, grid.intervals, float), at(kept, grid.inputs, float), at(kept, grid.slopes, float),
        at(kept, grid.jumps, np.uint8), len(grid.times), grid.inputs.shape[1], a.outputs.shape[2],
        at(kept, grid.gather, np.int64), at(kept, grid.by_time, np.int64),
        at(kept, grid.row_ends, np.int64), at(kept, grid.measured, float),
        at(kept, grid.sigmas, float),
    )  # fmt: skip


def settings(kept, a):
    s = a.settings
    return c.Settings(
        s.step, s.rtol, s.atol, at(kept, s.atols, float), s.max_steps, s.fmu_tolerance, s.fixed
    )


def effects(kept, hooks, program=None):
    """Of a program in place of the hooks' functions."""
    if program is None:
        return c.Effects()
    return c.Effects(
        program.address, at(kept, hooks.parameters, np.uint32), at(kept, hooks.fastest_rates),
        at(kept, hooks.coefficients), at(kept, hooks.base_parameters),
    )  # fmt: skip


def core_batch(method: str, a: KernelArguments, program: Any = None) -> CoreBatch:
    """The same batch for the core; results go where those of the loop would."""
    kept: list[Any] = [a, program]
    parts = (fmu(a.c), experiment(kept, a), settings(kept, a), effects(kept, a.hooks, program))
    kept.extend(parts)
    indices = np.zeros(max(1, len(a.points)), np.int64)
    for array in (a.outputs, a.codes, a.steps, a.stopped_at, a.work.progress):
        assert array.flags.c_contiguous
    batch = c.Batch(
        *map(addressof, parts), c.METHODS[method], len(a.points), a.points.shape[1],
        len(a.work.states), len(a.work.buffer), at(kept, a.points), at(kept, a.bounds),
        a.work.progress.ctypes.data, a.outputs.ctypes.data, a.codes.ctypes.data,
        indices.ctypes.data, a.steps.ctypes.data, a.stopped_at.ctypes.data,
    )  # fmt: skip
    return CoreBatch(batch, indices, kept)


def with_c_library():
    """The core with the C library's elementary functions, as the compiled loops have them."""
    return c.core(own_functions=False)


def integrator(known, states, library, jacobian=((), ())):
    """CVODE for a number of states, of those that are known or made now."""
    if states not in known:
        known[states] = CvodeIntegrator(states, library)
    known[states].use_jacobian(*jacobian)
    return known[states]


def simulate(
    method: str,
    a: KernelArguments,
    program: Any = None,
    core: Any = None,
    jacobian=((), ()),
    states_out=None,
    integrators=None,
) -> int:
    """In place of a numba loop."""
    made = core_batch(method, a, program)
    library = core or with_c_library()
    if method == "cvode" and made.batch.n_states:
        known = {} if integrators is None else integrators
        cvode = integrator(known, made.batch.n_states, library, jacobian)
        made.batch.cvode = cvode.address
        made.kept.append(cvode)
    if states_out is not None:
        made.batch.states_out = states_out.ctypes.data
    return int(library.core_simulate(ctypes.c_void_p(made.address)))
