"""Cases of one long record: one effect, an unknown initial state, the last third held out.

    from closed_loop_benchmark.single_records import one_record, single_records

    problem, data = one_record(single_records()[0])

The record contains the excitations of a system one after the other, from an unknown state. Most
engineers start with such data.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from closed_loop_benchmark.data import Data, make, make_problem
from closed_loop_benchmark.effect import SINGLE
from closed_loop_benchmark.scenarios import WHITE, Scenario, by_turns, scenario
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import integrate, lay_out
from cluster_est import Parameter, Problem
from cluster_est.problem.held_out import hold_out

CASES = 60
HELD_OUT = 1.0 / 3.0
FOUND_AT = 0.4
"""Share of an excitation after which the record begins."""
GUESSED = 0.1
"""Standard error of a guess of an initial state, over the range of the state."""


def single_records() -> list[Scenario]:
    """Return the cases, alternating between systems."""
    cases = [
        scenario(system, "single record", f"{effect.label} x{size}", WHITE[n % 2], [effect], size)
        for system, effects in SINGLE.items()
        for n, effect in enumerate(effects)
        for size in (0.25, 1.0)
    ]
    return by_turns(cases)[:CASES]


def one_record(case: Scenario) -> tuple[Problem, Data]:
    """Return the problem that a method is given, and its data."""
    system = SYSTEMS[case.system]
    random = np.random.default_rng(case.seed)
    runs = system.excitation(system.times, random)
    chosen = [runs[n] for n in random.permutation(len(runs))[: random.choice([3, 6])]]
    starts, ranges = _found(system, chosen)
    record = Run(
        "one record",
        "train",
        np.concatenate([run.inputs for run in chosen]),
        starts,
        np.concatenate([run.signals for run in chosen]),
    )
    long = replace(
        system,
        samples=len(record.inputs),
        excitation=lambda *_: [record],
        unknown_starts=system.states,
    )
    data = make(case, system=long)
    problem = make_problem(data)

    def guessed(parameter: Parameter) -> Parameter:
        """Give an initial state a guess, with bounds from the range of the state."""
        state = parameter.variable
        if state not in starts:
            return parameter
        guess = starts[state] + GUESSED * ranges[state] * random.normal()
        return replace(
            parameter, start=guess, bounds=(guess - ranges[state], guess + ranges[state])
        )

    parameters = tuple(guessed(each) for each in problem.parameters)
    end = float(long.times[-1])
    parts = hold_out(problem.experiments[0], [((1.0 - HELD_OUT) * end, end)])
    return replace(problem, parameters=parameters, experiments=parts), data


def _found(system: System, runs: list[Run]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the states within the first excitation, and the range of each in all."""
    course = lay_out(system, runs, (), ())
    values = [*system.parameters.values(), *system.constants.values()]
    states: Array = integrate(system, runs, (), course, values)[0]
    at = int(FOUND_AT * len(states))
    spans = np.ptp(states, axis=(0, 2))
    return (
        dict(zip(system.states, states[at, :, 0].tolist(), strict=True)),
        dict(zip(system.states, spans.tolist(), strict=True)),
    )
