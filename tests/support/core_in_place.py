"""The core in the place of all numba loops, so that any test can be run with it.

python -m pytest -p support.core_in_place tests/integration/fmus
"""

from __future__ import annotations

import ctypes
import operator
from ctypes import addressof
from functools import lru_cache, partial
from typing import Any

import numpy as np
from support.core_batches import at, core_batch, simulate, with_c_library
from support.core_batches import effects as core_effects

import cluster_est.closed_loop.screening.linear_system as screening
import workers.effects.outputs as outputs
import workers.simulation.bind_effects as bind_effects
import workers.simulation.integrator as integrator
import workers.simulation.linearise as linearise
import workers.simulation.sensitivities as sensitivities
import workers.simulation.simulator as simulator
from workers.core import library as c
from workers.core.assemble import Registers, assemble
from workers.effects.compiled import compile_inner, equations
from workers.effects.definition import SIGNAL_SYMBOL, TIME_SYMBOL, variable_symbol
from workers.effects.machine_code import CAssignment, EffectArray
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.solvers.cvode import CvodeBatch

_sources: dict[tuple[int, ...], Any] = {}
"""What functions by address were compiled from."""
_kept: list[Any] = []


def address(function):
    return function.address if function else 0


def recorded_inner(*given):
    """As `compile_inner`, which the core finds again by the functions' addresses."""
    inner = compile_inner(*given)
    key = (inner.start_states, inner.modify_inputs, inner.add_derivatives)
    _sources[tuple(map(address, key))] = given
    _kept.append(inner)
    return inner


_compile_output = outputs._compile


def recorded_output(*given):
    compiled = _compile_output(*given)
    _sources[tuple(compiled.hooks())] = given
    _kept.append(compiled)
    return compiled


@lru_cache(maxsize=512)
def inner_program(given, states, coefficients, base):
    laid_out = equations(*given)
    own = len(laid_out.start_states)
    registers = Registers(states, own, len(given[3]), coefficients, base, len(laid_out.parameters))
    code = assemble(
        registers, laid_out.locations, TIME_SYMBOL, laid_out.start_states, laid_out.modify_inputs,
        laid_out.add_derivatives,
    )  # fmt: skip
    return c.LoadedProgram(code, with_c_library())


def program_of(hooks, work):
    """The byte code of an experiment's effects; None without any."""
    key = tuple(hooks[:3])
    if not any(key):
        return None
    shape = (len(work.states), hooks.coefficients.shape[1], hooks.base_parameters.shape[1])
    return inner_program(_sources[key], *shape)


@lru_cache(maxsize=512)
def output_program(definition, recorded, inputs):
    """The byte code of an effect at an output."""
    places = {variable_symbol(n): (EffectArray.INPUTS, i) for i, n in enumerate(inputs)}
    places |= {variable_symbol(n): (EffectArray.OUTPUTS, i) for i, n in enumerate(recorded)}
    places[SIGNAL_SYMBOL] = (EffectArray.OUTPUTS, recorded.index(definition.site.target))
    places |= {s: (EffectArray.COEFFICIENTS, i) for i, s in enumerate(definition.coefficients)}
    places |= {s: (EffectArray.STATES, i) for i, s in enumerate(definition.states)}
    own = len(definition.states)
    registers = Registers(
        own, own, len(inputs) + len(recorded), len(definition.coefficients), 0, 1, len(recorded)
    )

    def assigned(array, values):
        return [CAssignment(array, i, value) for i, value in enumerate(values)]

    code = assemble(
        registers, places, TIME_SYMBOL, assigned(EffectArray.STATES, definition.starts),
        assigned(EffectArray.RESULT, [e for _, e in definition.equations]),
        assigned(EffectArray.DERIVATIVES, definition.derivatives),
    )  # fmt: skip
    return c.LoadedProgram(code, with_c_library())


def batch_with(method):
    return lambda a: simulate(method, a, program_of(a.hooks, a.work))


def cvode_batch(self, arguments, states=None):
    jacobian = (self.jacobian.states.tolist(), self.jacobian.derivatives.tolist())
    program = program_of(arguments.hooks, arguments.work)
    own = self.__dict__.setdefault("of_core", {})
    return simulate(
        "cvode", arguments, program, jacobian=jacobian, states_out=states, integrators=own
    )


def single(method, head, grid, point, work, outputs_=None, program=None):
    """A batch of one point, from the arguments of a loop for one."""
    n = len(grid.times)
    row = np.zeros((n, 1)) if outputs_ is None else outputs_
    results = np.zeros(1, np.int64), np.zeros(1), np.zeros(1, np.int64)
    arguments = KernelArguments._make(
        (*head, grid, point[None], np.full(1, np.inf), work, row[None], *results)
    )
    return core_batch(method, arguments, program_of(head[4], work) if program is None else program)


def called(function, made, *structures):
    getattr(with_c_library(), function)(made.address, *map(addressof, structures))
    a = made.kept[0]
    return int(a.codes[0]), float(a.stopped_at[0])


def linearisation(kept, made, stepping, offsets, work, perturbed, result):
    def ranges(r):
        return c.Range(at(kept, r.nominals), at(kept, r.lows), at(kept, r.highs), len(r.nominals))

    own = core_effects(kept, offsets, program_of(offsets, work))
    kept.append(own)
    return c.Linearisation(
        {0: c.DORMAND_PRINCE, 1: c.RUNGE_KUTTA, 2: c.CVODE}[stepping], addressof(own),
        perturbed.input_offsets, len(perturbed.inputs.nominals), ranges(perturbed.states),
        ranges(perturbed.inputs), ranges(perturbed.parameters),
        at(kept, perturbed.references, np.uint32), at(kept, perturbed.values),
        at(kept, perturbed.effect_positions, np.int64),
        *(getattr(result, n).ctypes.data for n in (
            "states", "derivatives", "effective_inputs", "A", "B", "P", "C", "D", "Q")),
    )  # fmt: skip


def core_linearise(
    stepping, cc, references, starts, settings, hooks, offsets, grid, point, work, perturbed,
    result, outputs_,
):  # fmt: skip
    made = single("rk4", (cc, references, starts, settings, hooks), grid, point, work, outputs_)
    of = linearisation(made.kept, made, stepping, offsets, work, perturbed, result)
    return called("core_linearise", made, of)


def core_filter(
    stepping, cc, references, starts, settings, hooks, offsets, grid, point, work, perturbed,
    result, kalman, outputs_,
):  # fmt: skip
    made = single("rk4", (cc, references, starts, settings, hooks), grid, point, work, outputs_)
    of = linearisation(made.kept, made, stepping, offsets, work, perturbed, result)
    names = ("diffusion", "measured", "variances", "innovations", "spreads", "covariance")
    return called(
        "core_filter", made, of, c.Kalman(*(getattr(kalman, n).ctypes.data for n in names))
    )


class Compilable:
    """A function of the core where one that numba compiles was."""

    def __init__(self, function):
        self._function = function

    def __call__(self, *given):
        return self._function(*given)

    def compile(self, _types):
        """There is nothing to do."""


def core_forward(
    fixed, cc, references, starts, settings, hooks, grid, point, work, forward, outputs_
):
    method = "rk4" if fixed else "dormand_prince"
    made = single(method, (cc, references, starts, settings, hooks), grid, point, work, outputs_)
    f, kept = forward, made.kept
    structure = c.Sensitivities(
        len(f.kinds), at(kept, f.kinds, np.int64), at(kept, f.positions, np.int64),
        at(kept, f.references, np.uint32), at(kept, f.handles, np.int64), at(kept, f.values),
        at(kept, f.knowns, np.uint32), at(kept, f.derivative_references, np.uint32),
        at(kept, f.output_references, np.uint32), at(kept, f.output_positions, np.int64),
        at(kept, f.output_states, np.int64), len(f.output_references),
        f.sensitivities.ctypes.data,
    )  # fmt: skip
    return called("core_sensitivities", made, structure)


def core_is_known(
    cc, references, starts, settings, hooks, grid, point, work, unknowns, known, derivatives
):
    made = single("rk4", (cc, references, starts, settings, hooks), grid, point, work)
    status = with_c_library().core_is_known(
        made.address, at(made.kept, unknowns, np.uint32), len(unknowns), int(known[0]),
        derivatives.ctypes.data,
    )  # fmt: skip
    return int(made.kept[0].codes[0]), status


def core_stiffness(cc, references, starts, settings, hooks, grid, point, work):
    made = single("rk4", (cc, references, starts, settings, hooks), grid, point, work)
    stiff = with_c_library().core_is_stiff(made.address)
    return bool(stiff), int(made.kept[0].codes[0])


def core_apply(hooks, grid, seen, column, coefficients, motion, _work):
    kept: list[Any] = []
    program = output_program(*_sources[tuple(hooks)])
    assert seen.flags.c_contiguous
    record = c.Record(
        at(kept, grid.times), at(kept, grid.inputs), at(kept, grid.slopes), len(grid.times),
        grid.inputs.shape[1], seen.shape[1], column, program.address, at(kept, coefficients),
        motion.rate, motion.decay, seen.ctypes.data,
    )  # fmt: skip
    assert with_c_library().core_apply_to_outputs(addressof(record)) == 0


def memory(name, signal, coefficient):
    """A form with memory, by the core."""
    times, values = (np.ascontiguousarray(a, float) for a in signal[:2])
    n, held = len(times), signal.interpolation == "hold"
    if name.startswith("rate_limit") and not np.isfinite(coefficient):
        return signal
    to, out = np.zeros((2, 2 * n + 1))
    where = (times.ctypes.data, values.ctypes.data, n)
    result = (to.ctypes.data, out.ctypes.data)
    if name == "delay":
        count = with_c_library().core_delay(*where, coefficient, *result)
    elif name == "backlash":
        count = with_c_library().core_backlash(*where, coefficient, *result)
    else:
        start = float(values[0]) if name == "rate_limit" else 0.0
        count = with_c_library().core_rate_limit(*where, held, start, coefficient, *result)
    changed = SampledSignal(to[:count].copy(), out[:count].copy())
    return (
        changed
        if name.startswith("rate_limit")
        else changed._replace(interpolation=signal.interpolation)
    )


def core_linear(function):
    def run(keep, first, last, forcing, now, after):
        scratch = np.zeros((2, *now.shape))
        whole = np.ascontiguousarray(forcing)
        arrays = [np.ascontiguousarray(a, float) for a in (keep, first, last)]
        n, x, m = forcing.shape
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (*arrays, whole, scratch)]
        getattr(with_c_library(), function)(*pointers, n, x, m)
        forcing[:] = whole

    return run


def replacements() -> list[tuple[Any, str, Any]]:
    """Where a loop is called from, by which name, and what takes its place."""
    return [
        (CvodeBatch, "__call__", cvode_batch),
        (bind_effects, "compile_inner", recorded_inner),
        (outputs, "_compile", recorded_output),
        (outputs, "apply_to_outputs", core_apply),
        (linearise, "linearise", core_linearise),
        (linearise, "filter_states", core_filter),
        (sensitivities, "simulate_forward", Compilable(core_forward)),
        (sensitivities, "is_known", Compilable(core_is_known)),
        (simulator, "stiffness", Compilable(core_stiffness)),
        (screening, "run_linear", core_linear("core_run_linear")),
        (screening, "run_adjoint", core_linear("core_run_adjoint")),
    ]


def tables() -> list[tuple[dict[str, Any], str, Any]]:
    """Of functions that are found by a name."""
    batches = [(integrator.BATCHES, m, batch_with(m)) for m in ("fmu", "rk4", "dormand_prince")]
    return [*batches, *((MEMORIES, name, partial(memory, name)) for name in MEMORIES)]


def install(patch: Any = None) -> None:
    """Put the core in the place of all loops, for good or as long as a `MonkeyPatch` says."""
    for where, name, function in replacements():
        (setattr if patch is None else patch.setattr)(where, name, function)
    for table, name, function in tables():
        (operator.setitem if patch is None else patch.setitem)(table, name, function)


def pytest_configure(config):
    install()
