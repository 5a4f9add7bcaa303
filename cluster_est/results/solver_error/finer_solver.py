"""More accurate solvers, to measure the error of the solver of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.fmu.description import ModelDescription
from workers.grid import build_grid
from workers.messages import Experiment, Model, Solver
from workers.simulation.integrator import DEFAULT_RTOL


def communication_step(model: Model, description: ModelDescription) -> float:
    """Return the step of an FMU with a fixed communication step, in seconds.

    Between two communication points, inputs are held and outputs interpolated, also if the interval
    of the data is shorter. The result is 0.0 if every time in the data is a communication point, or
    if the step depends on the experiment.
    """
    if model.interface != "co_simulation" or description.variable_steps:
        return 0.0
    own = (model.solver.step, description.fixed_internal_step, description.default_step)
    return next((step for step in own if step is not None and step > 0.0), 0.0)


def fixed_step(model: Model) -> float:
    """Return the longest step, in seconds, of a solver that does not shorten steps at events.

    It is infinite if each step extends from one time in the data to the next. It is 0.0 for solvers
    that control their error.
    """
    if model.solver.name != "rk4":
        return 0.0
    return model.solver.step or math.inf


RTOL_TIGHTENING = 100.0
"""Factor by which a relative tolerance is tightened to measure the error of a solver."""
LEAST_RTOL = 1e-13
"""Least relative tolerance; below it, rounding errors dominate."""
WHOLE_STEP_TOLERANCE = 1e-6
"""Relative tolerance for a step that must be a multiple of the FMU's step."""


@dataclass(frozen=True)
class SolverScale:
    """The setting that determines the accuracy of a solver: its step, or its tolerance.

    Attributes
    ----------
    solver
        The declared solver.
    name
        Start of a sentence, such as "the communication step of 0.1 s".
    step
        The step in seconds; 0.0 if a tolerance determines the accuracy.
    rtol, longest
        The tolerance, and the longest step, which the times of the data limit. With closely spaced
        samples, this step determines the accuracy, and a tighter tolerance alone has no effect. 0.0
        if a step determines the accuracy.
    ratio
        Factor by which `finer` divides the step or the tolerance.
    fixed
        Whether the FMU declares a fixed communication step; other steps may not be possible.
    own_step
        The internal step of such an FMU, if it is known; only multiples of it are possible.
    exchange
        Whether the FMU is used in co-simulation but offers model exchange, which has no
        communication steps.
    why_not
        Part of a sentence: why there is no more accurate solver; "" if there is one.
    """

    solver: Solver
    name: str
    step: float = 0.0
    rtol: float = 0.0
    longest: float = 0.0
    ratio: float = 2.0
    fixed: bool = False
    own_step: float = 0.0
    exchange: bool = False
    why_not: str = ""

    def finer(self, times: int = 1) -> Solver:
        """Return a solver whose step or tolerance is divided by `ratio`, `times` times.

        With a tolerance, it is divided once, and the longest step is also halved. The tolerance of
        an FMU is divided by 100 once.
        """
        solver = self.solver
        if not self.step:
            tight = _tightened(solver, self.rtol, self.rtol / self.ratio)
            return replace(tight, step=self.longest / 2.0)
        if solver.name == "fmu" and solver.rtol is not None:
            solver = _tightened(solver, solver.rtol, max(solver.rtol / RTOL_TIGHTENING, LEAST_RTOL))
        return replace(solver, step=self.step / self.ratio**times)

    def can_be_finer_twice(self) -> bool:
        """Return whether a third, still finer solution is possible, which shows the order."""
        if not self.step:
            return False
        return not self.own_step or _is_whole(self.step / self.ratio**2 / self.own_step)

    def advice(self, factor: float, order: float) -> str:
        """Return the config keys that reduce the error by a factor.

        The error of a method of order p with step h is proportional to h^p. With a tolerance, the
        error is proportional to the tolerance (E. Hairer, S. P. Norsett, G. Wanner, Solving
        Ordinary Differential Equations I, sections II.3 and II.4, doi:10.1007/978-3-540-78862-1).
        """
        factor = max(factor, 1.0)
        if not self.step:
            rtol = max(10.0 ** np.floor(np.log10(self.rtol / factor)), LEAST_RTOL)
            atol = self.solver.atol
            said = f"model.rtol = {rtol:.0e}"
            return said if atol is None else f"{said} and atol = {atol * rtol / self.rtol:.1g}"
        halvings = max(int(np.ceil(np.log2(factor) / order)), 1)
        step = self.step / 2.0**halvings
        if self.own_step:
            step = self.own_step * max(np.floor(step / self.own_step + WHOLE_STEP_TOLERANCE), 1.0)
        said = f"model.step = {step:.4g}"
        if self.solver.name == "fmu" and self.solver.rtol is not None:
            said += f" and rtol = {max(self.solver.rtol / RTOL_TIGHTENING, LEAST_RTOL):.1g}"
        return f'{said} (or model.interface = "model_exchange")' if self.exchange else said


def solver_scale(
    model: Model, description: ModelDescription, experiments: Sequence[Experiment]
) -> SolverScale:
    """Return the setting that determines the accuracy of the solver in these experiments."""
    solver, usual = model.solver, usual_interval(experiments)
    step = min(solver.step or usual, usual)
    if solver.name == "rk4":
        return SolverScale(solver, f"the step of {step:.4g} s", step=step)
    if solver.name == "fmu":
        known = f"the communication step of {step:.4g} s"
        found = SolverScale(solver, known, step=step) if description.variable_steps else None
        found = found or _fixed(model, description)
        return replace(found, exchange="model_exchange" in description.interfaces)
    rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
    tight = max(rtol / RTOL_TIGHTENING, LEAST_RTOL)
    why = "" if tight < rtol else "a tighter tolerance is not possible in double precision"
    name = f"the tolerance model.rtol = {rtol:.1g}"
    return SolverScale(solver, name, rtol=rtol, longest=step, ratio=rtol / tight, why_not=why)


def step_never_taken(
    model: Model, description: ModelDescription, experiments: Sequence[Experiment]
) -> str:
    """Return a note if the step is longer than every interval of the data; "" otherwise."""
    solver = model.solver
    fixed = solver.name == "fmu" and not description.variable_steps
    if solver.step is None or fixed:
        return ""
    longest = max(float(np.diff(build_grid(run).times).max(initial=0.0)) for run in experiments)
    if solver.step <= longest * (1.0 + WHOLE_STEP_TOLERANCE):
        return ""
    return (
        f"model.step = {solver.step:.4g} has no effect: the times of inputs and measurements are "
        f"at most {longest:.4g} s apart, and no step extends beyond the next of these times; "
        "remove model.step"
    )


def usual_interval(experiments: Sequence[Experiment]) -> float:
    """Return the median interval of the data, with the intervals' lengths as weights."""
    intervals = np.sort(np.concatenate([np.diff(build_grid(run).times) for run in experiments]))
    spent = np.cumsum(intervals)
    return float(intervals[np.searchsorted(spent, 0.5 * spent[-1])])


def _fixed(model: Model, description: ModelDescription) -> SolverScale:
    """Return the scale of an FMU with a fixed communication step; the user may know other steps."""
    own = description.fixed_internal_step or 0.0
    solver, step = model.solver, communication_step(model, description)
    name = f"the communication step of {step:.4g} s" if step else "the communication step"
    refused = SolverScale(
        solver, name, why_not=f"{description.file} communicates with a fixed step"
    )
    if solver.step is None or not step:
        return refused
    if not own:
        return SolverScale(solver, name, step=step, fixed=True)
    multiple = step / own
    if not _is_whole(multiple) or round(multiple) < 2:
        return refused
    count = round(multiple)
    ratio = next(q for q in range(2, count + 1) if count % q == 0)
    return SolverScale(solver, name, step=step, ratio=float(ratio), fixed=True, own_step=own)


def _is_whole(number: float) -> bool:
    return round(number) >= 1 and abs(number - round(number)) <= WHOLE_STEP_TOLERANCE * number


def _tightened(solver: Solver, rtol: float, tight: float) -> Solver:
    atol = None if solver.atol is None else solver.atol * tight / rtol
    return replace(solver, rtol=tight, atol=atol)
