"""Springs as sensors see them: outputs that are changed, on known starts and of a known mass."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from support.problems.springs import ROOT, TRUE, spring_problem
from support.run_folders import rows

from cluster_est import Output, Problem

MASS_IS_KNOWN = ["parameters.m.fixed=true", f"parameters.m.start={TRUE['m']}"]


def with_outputs(problem: Problem, change: Callable[..., Output]) -> Problem:
    """The problem with every output changed."""
    runs = tuple(
        replace(run, outputs=tuple(map(change, run.outputs))) for run in problem.experiments
    )
    return replace(problem, experiments=runs)


def seen_springs(see: Callable[[Output, int], Output]) -> Problem:
    """Three experiments without noise, of which `see` makes what is measured, by their number."""
    truth, runs = spring_problem(3), []
    for number, experiment in enumerate(truth.problem.experiments):
        (output,) = experiment.outputs
        start = (("x", truth.values[f"x0[{experiment.id}]"]),)
        runs.append(replace(experiment, outputs=(see(output, number),), values=start))
    known = tuple(
        replace(p, start=TRUE["m"], fixed=True) if p.name == "m" else p
        for p in truth.problem.parameters
    )
    return replace(truth.problem, parameters=known, experiments=tuple(runs))


def example_without_outputs(data: str = "") -> str:
    """The text of the example's config, to be read anywhere; with `data` in place of its folder."""
    text = (ROOT / "configs" / "mass_spring_damper.toml").read_text(encoding="utf-8")
    text = "\n".join(line for line in text.splitlines() if not line.startswith("outputs"))
    configs = f'"{ROOT.as_posix()}/configs'
    text = text.replace('"models/', f"{configs}/models/")
    return text.replace('"data/mass_spring_damper/', data or f"{configs}/data/mass_spring_damper/")


def values_of(run: Path) -> dict[str, float]:
    """What a run has found."""
    return {row["label"]: row["value"] for row in rows(run, "parameters")}
