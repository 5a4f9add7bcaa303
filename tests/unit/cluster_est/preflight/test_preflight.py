"""What is looked at in an FMU without a config, and what is said of probes without an answer."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.described import real, write_fmu
from support.problems.springs import FMU
from support.spoiled import spoiled_fmu

from cluster_est import Parameter, Resources
from cluster_est.errors import ModelError
from cluster_est.preflight import CheckFinding, bare_problem, run_checks
from workers.probes.directional import DirectionalProbe
from workers.probes.probes import CostProbe, LeftoverProbe, MovementProbe, SimulationCost
from workers.process.trial import BenchHere, NoAnswer, ProbeBench


def parameter(name: str, reference: int = 0, variability: str = "fixed", start: float = 1) -> str:
    return real(name, "parameter", reference, variability=variability, start=start)


@pytest.mark.parametrize(
    ("variables", "parameters"),
    [
        (
            [
                parameter("k"),
                parameter("c", variability="constant"),
                parameter("d", 4),
                real("also_d", "local", 4, variability="constant", start=1),
            ],
            ["k"],
        ),
        ([parameter(name) for name in ("_nle_tolerance", "solver.$step", "mass_")], ["mass_"]),
    ],
    ids=["nothing that is constant under any of its names", "no options of the tool"],
)
def test_what_is_set(tmp_path, variables, parameters):
    found = bare_problem(write_fmu(tmp_path, real("y", "output"), *variables))
    assert [parameter.name for parameter in found.parameters] == parameters


def test_where_nothing_is_an_output_what_moves_is_looked_at(tmp_path):
    fixed = real("fixed", "local", variability="fixed", start=1.0)
    u = real("u", "input", start=0.0)
    found = bare_problem(write_fmu(tmp_path, real("p", "local"), fixed, u))
    assert found.experiments[0].recorded == ("p",)
    with pytest.raises(ModelError, match="another number that changes"):
        bare_problem(write_fmu(tmp_path, u))


class Answered(ProbeBench):
    """Asks in this process what has no answer already."""

    def __init__(self, answers: dict[Any, Any], *given: Any) -> None:
        self.answers, self.bench = answers, BenchHere(*given)

    def ask(self, probe: Any, seconds: float) -> Any:
        for (kind, points), answer in self.answers.items():
            if isinstance(probe, kind) and points in (0, len(getattr(probe, "others", ()))):
                return answer
        return self.bench.ask(probe, seconds)

    def close(self) -> None:
        self.bench.close()


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """The mass-spring-damper with bounds, and with directional derivatives as it says."""
    path = tmp_path_factory.mktemp("fmu") / "x.fmu"
    offers = 'providesDirectionalDerivative="true"'
    path.write_bytes(spoiled_fmu(xml={"<ModelExchange ": f"<ModelExchange {offers} "}))
    problem = bare_problem(path)
    given = [Parameter(p.name, p.start, 0.1, 50.0) for p in problem.parameters]
    return replace(problem, parameters=tuple(given))


def findings(problem, kind: type, answer: Any, check: str, points: int = 0) -> list[CheckFinding]:
    """Those of one check where a kind of probe, for so many points, has this answer."""
    quick = {(CostProbe, 0): SimulationCost(1e-3, 0.0, 300)}

    def opened(*given: Any) -> ProbeBench:
        return Answered({**quick, (kind, points): answer}, *given)

    page = run_checks(problem, Resources(), 60.0, declared=False, open_bench=opened)
    return [each for each in page.findings if each.check == check]


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ([0.1, 0.2], [("ok", "at their lower and upper bounds")]),
        ([0.1], [("ok", "simulated with all parameters at their lower bounds"),
                 ("not done", "not simulated with all parameters at their upper bounds")]),
        ([], [("not done", "not simulated with all parameters at their lower and upper bounds")]),
        (["it stops"], [("note", "lower bounds: it stops"), ("not done", "at their upper bounds")]),
        (["it stops", 0.2], [("note", "lower bounds: it stops")]),
    ],
)  # fmt: skip
def test_only_bounds_that_were_tried_are_said_to_be_good(spring, answer, expected):
    found = findings(spring, MovementProbe, answer, "bounds", points=2)
    assert [each.verdict for each in found] == [verdict for verdict, _ in expected]
    assert all(said in each.found for each, (_, said) in zip(found, expected, strict=True))


def jacobian(error: float) -> SimpleNamespace:
    return SimpleNamespace(error=error, zero=False)


@pytest.mark.parametrize(
    ("kind", "answer", "check", "verdict", "said"),
    [
        (DirectionalProbe, jacobian(1e-9), "derivatives", "ok", "agree"),
        (DirectionalProbe, jacobian(1.0), "derivatives", "note", "differ"),
        (DirectionalProbe, jacobian(np.nan), "derivatives", "note", "differ"),
        (CostProbe, SimulationCost(1e-3, None, 64), "memory", "not done", "64 simulations are too"),
        (CostProbe, SimulationCost(1e-3, 0.0, 64), "memory", "not done", "64 simulations are too"),
        (CostProbe, SimulationCost(1.1, 0.0, 300), "few simulations", "ok", "takes long"),
        (LeftoverProbe, NoAnswer("it would take 5 s", late=True), "values", "not done", "5 s"),
    ],
)
def test_what_is_not_known_is_not_said_to_be_good(spring, kind, answer, check, verdict, said):
    (found,) = findings(spring, kind, answer, check)
    assert found.verdict == verdict
    assert said in found.found


def test_no_plan_for_few_simulations_where_each_is_quick(spring):
    assert findings(spring, CostProbe, SimulationCost(0.9, 0.0, 300), "few simulations") == []


def test_an_fmu_that_was_not_tried_is_said_to_be_that():
    (found,) = run_checks(bare_problem(FMU), Resources(), 0.0, declared=False).findings
    assert found.verdict == "not done"
    assert "nothing was simulated" in found.found
