"""The model and its start values in a terminal, before a fit and with `simulate`."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from cluster_est.cli.display.run import number, print_table, say
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space.space import make_space
from cluster_est.results.output_errors import Simulation
from cluster_est.results.tables.rows import constraints_at_start


def print_model(console: Console, problem: Problem, more: str) -> None:
    """Print the model, the faults of its description, and how it is simulated."""
    model = problem.model
    say(
        console,
        f"{model.name}: {model.interface.replace('_', ' ')}, solver {model.solver.name}; {more}",
    )
    for warning in (*problem.describe().warnings, *problem.model_notes()):
        say(console, warning)


def print_check(console: Console, problem: Problem, simulations: Sequence[Simulation]) -> None:
    """Unknowns, experiments and one simulation of each."""
    train = make_space(problem, problem.indices("train"))
    say(
        console,
        f"{train.size} unknowns; a forward Jacobian costs {len(train.colours)} points x "
        f"{len(train.experiments)} experiments",
    )
    rows = []
    for simulation in simulations:
        experiment, outcome = problem.experiments[simulation.experiment], simulation.outcome
        rows.append(
            (
                experiment.id,
                experiment.role,
                f"{experiment.start:g} .. {experiment.stop:g}",
                str(experiment.size),
                number(outcome.seconds * 1e3),
                outcome.message or str(outcome.status),
            )
        )
    print_table(console, ["experiment", "role", "seconds", "samples", "ms", "simulated"], rows)
    if train.constraint_names:
        kinds = ["= 0" if equal else "<= 0" for equal in train.equality]
        values = [number(value) for value in constraints_at_start(train, list(simulations))]
        named = zip(train.constraint_names, kinds, values, strict=True)
        print_table(console, ["constraint", "must be", "at the start"], named)
