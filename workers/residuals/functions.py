"""User-defined Python functions, which replace residuals or serve as constraints."""

from __future__ import annotations

import importlib
import pickle
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workers.errors import ModelError
from workers.messages import Experiment, FloatArray, UserFunction
from workers.residuals.comparison import Comparison, ComparisonResult, SimulatedOutputs, positions


@dataclass(frozen=True)
class SimulatedRun:
    """One simulation of one experiment, as the argument of a user's function.

    Attributes
    ----------
    experiment
        Id of the experiment.
    times : (n,)
        Recorded times of the simulation.
    simulated
        (n,) by variable: every output, and every signal that a constraint names.
    measured
        (times, values) by variable.
    sigma
        Standard deviation of the measured values, by variable; (n,) if it depends on them.
    values
        Values of the parameters, by the FMU's names.
    """

    experiment: str
    times: FloatArray = field(repr=False)
    simulated: dict[str, FloatArray] = field(repr=False)
    measured: dict[str, tuple[FloatArray, FloatArray]] = field(repr=False)
    sigma: dict[str, float | FloatArray]
    values: dict[str, float]

    def residuals(self, variable: str) -> FloatArray:
        """Return (measured - simulated) / sigma of an output at its measured times."""
        times, measured = self.measured[variable]
        found = self.simulated[variable][positions(times, self.times)]
        return (measured - found) / self.sigma[variable]


class FunctionComparison(Comparison):
    """Calls a user's function for each point.

    Parameters
    ----------
    function
        Takes a `SimulatedRun`, and returns a number or a vector of numbers.
    experiment, parameters
        The experiment, and the names of the parameters.
    single
        Whether the function must return a single number.

    Raises
    ------
    ModelError
        If the function does not exist on this machine.
    """

    def __init__(
        self,
        function: UserFunction,
        experiment: Experiment,
        parameters: tuple[str, ...],
        *,
        single: bool,
    ) -> None:
        self._call = load(function)
        self._name = f"{function.module}:{function.name}"
        self._experiment, self._parameters, self._single = experiment, parameters, single
        self._size = 1 if single else -1

    def compare(self, simulated: SimulatedOutputs) -> ComparisonResult:
        found: dict[int, FloatArray] = {}
        failures: dict[int, str] = {}
        for p in range(len(simulated.outputs)):
            if not np.isfinite(simulated.outputs[p]).all():
                failures[p] = ""  # the failed simulation has its own message
                continue
            try:
                found[p] = self._checked(self._call(self._run(simulated, p)))
            except (Exception, SystemExit) as error:  # a user's code may raise anything
                failures[p] = f"{self._name} failed ({type(error).__name__}: {error})"
        values = np.full((len(simulated.outputs), max(self._size, 0)), np.nan)
        for p, row in found.items():
            values[p] = row
        return ComparisonResult(values, failures)

    def _checked(self, answer: Any) -> FloatArray:
        if answer is None or np.iscomplexobj(answer):
            raise TypeError(f"it must return real numbers, but returned a {type(answer).__name__}")
        values = np.atleast_1d(np.asarray(answer, np.float64)).ravel()
        if self._size < 0 and len(values):
            self._size = len(values)
        if len(values) != self._size:
            before = f"{self._size} numbers, as in the first call" if self._size > 0 else "numbers"
            must = "one number" if self._single else before
            raise ValueError(f"it must return {must}, but returned {len(values) or 'none'}")
        if not np.isfinite(values).all():
            bad = values[~np.isfinite(values)][0]
            raise ValueError(f"it must return finite numbers, but returned {bad}")
        return values

    def _run(self, simulated: SimulatedOutputs, p: int) -> SimulatedRun:
        outputs = self._experiment.outputs
        return SimulatedRun(
            experiment=self._experiment.id,
            times=_lent(simulated.times),
            simulated={n: _lent(simulated.outputs[p, :, i]) for i, n in enumerate(simulated.names)},
            measured={o.variable: (_lent(o.times), _lent(o.values)) for o in outputs},
            sigma={o.variable: o.sigmas if o.relative_sigma else o.sigma for o in outputs},
            values=dict(zip(self._parameters, simulated.values[p].tolist(), strict=False)),
        )


def _lent(values: FloatArray) -> FloatArray:
    """Return a read-only view, because the array is also used elsewhere."""
    view = values.view()
    view.flags.writeable = False
    return view


def load(function: UserFunction) -> Callable[[SimulatedRun], Any]:
    """Import a function, or create it from the source text of its module.

    Raises
    ------
    ModelError
        If this fails.
    """
    where = f"{function.module}:{function.name}"
    try:
        if function.pickled:
            found = pickle.loads(function.pickled)
        else:
            module = _from_source(function) if function.source else _imported(function.module)
            found = getattr(module, function.name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise ModelError(
            f"{where}: must be a function that can be imported, but cannot be imported "
            f"({type(error).__name__}: {error}); correct it, install what it imports on each "
            "worker, or put its file beside the config"
        ) from error
    if not callable(found):
        raise ModelError(f"{where}: must be a function, but is a {type(found).__name__}")
    called: Callable[[SimulatedRun], Any] = found
    return called


def _imported(name: str) -> types.ModuleType:
    return importlib.import_module(name)


def _from_source(function: UserFunction) -> types.ModuleType:
    name = f"{__name__}.of_the_user.{function.module}"  # it must not replace an installed module
    module = types.ModuleType(name)
    sys.modules[name] = module  # dataclasses need their module there
    exec(compile(function.source, f"{function.module}.py", "exec"), module.__dict__)
    return module
