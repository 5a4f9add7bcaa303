"""`cluster-est check` names each misbehaving FMU for what it is, and good ones have no problem."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import ROOT

from cluster_est import Problem
from cluster_est.cli import main
from cluster_est.preflight import CheckFinding, CheckPage, bare_problem, run_checks
from cluster_est.problem.parameter import Parameter
from cluster_est.running.resources import Resources
from workers.messages import Effect, Solver
from workers.process.trial import BenchHere, ProbeBench

Give = Callable[[str, int], Path]
Examine = Callable[..., CheckPage]
Capture = pytest.CaptureFixture[str]

MINUTE = 60.0
"""So much time that nothing is left out on a busy machine."""
HARMLESS = {
    *("thermostat", "van_der_pol", "dead_parameter", "wrong_directional", "zero_directional"),
    *("robertson", "fails_to_reset", "reset_keeps_state", "reset_spoils_directional"),
    *("refuses_parameter", "needs_library", "no_licence"),
}
"""Asked in this process, which a process of their own would only make slower."""


@pytest.fixture
def examined(own_fmu: Give) -> Examine:
    """The page of one of the project's own FMUs."""

    def look(
        name: str, fmi: int = 2, seconds: float = MINUTE, executor: str = "local"
    ) -> CheckPage:
        problem = bare_problem(own_fmu(name, fmi))
        resources = Resources(executor=executor)
        bench = BenchHere if name in HARMLESS else ProbeBench.open
        return run_checks(problem, resources, seconds, declared=False, open_bench=bench)

    return look


def looked_at(problem: Problem) -> CheckPage:
    """The page of a problem that does no harm to this process."""
    return run_checks(problem, Resources(), MINUTE, open_bench=BenchHere)


def line(page: CheckPage, check: str) -> CheckFinding:
    return next(each for each in page.findings if each.check == check)


def in_co_simulation(problem: Problem, step: float | None = None) -> Problem:
    model = replace(problem.model, interface="co_simulation", solver=Solver("fmu", step))
    return replace(problem, model=model)


slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "fmi"),
    [
        ("dahlquist", 3),
        ("thermostat", 2),
        pytest.param("dahlquist", 2, marks=slow),
        pytest.param("van_der_pol", 3, marks=slow),
    ],
)
def test_a_good_fmu(examined: Examine, name: str, fmi: int) -> None:
    page = examined(name, fmi)

    assert page.good
    assert {each.verdict for each in page.findings} == {"ok"}
    assert line(page, "memory").found.startswith("no leak in ")


@pytest.mark.parametrize(
    ("name", "fmi", "check", "verdict", "found", "do"),
    [
        ("reset_keeps_state", 2, "reset", "note", "0.035 of the outputs' size", "model.reset"),
        ("reset_crashes", 2, "reset", "note", "its process crashed (SIGSEGV)", "model.reset"),
        ("fails_to_reset", 3, "values", "note", "survive a reset", "model.reset"),
        ("random_output", 2, "repeatable", "problem", "two fresh processes differ", "method.name"),
        ("once_per_process", 3, "instances", "note", "and says so", "executor.name"),
        ("once_undeclared", 2, "instances", "note", "and does not say so", "executor.name"),
        ("shares_static", 2, "instances", "note", "give other results while", "executor.name"),
        pytest.param(
            *("shares_static", 3, "instances", "note", "give other results while", "executor.name"),
            marks=slow,
        ),
        ("dead_parameter", 3, "dead parameters", "note", "depend on dead", "inputs are driven"),
        ("wrong_directional", 2, "derivatives", "note", "differ from the model's slopes", "export"),
        ("zero_directional", 3, "derivatives", "note", "all are silently 0", "export"),
        ("robertson", 2, "stiffness", "note", "is stiff", 'model.solver = "cvode"'),
        ("needs_library", 2, "loads", "problem", "libnobody_has_this.so", ""),
        ("no_licence", 3, "loads", "problem", "no licence for this model", ""),
        ("crashes_at_start", 2, "experiment default", "problem", "crash: ", ""),
        pytest.param(
            *("crashes_at_start", 3, "experiment default", "problem", "crash: ", ""), marks=slow
        ),
        ("hangs_at_start", 2, "experiment default", "problem", "did not end within", ""),
    ],
)
def test_what_is_wrong_is_named(
    examined: Examine, name: str, fmi: int, check: str, verdict: str, found: str, do: str
) -> None:
    page = examined(name, fmi, seconds=2.0 if name == "hangs_at_start" else MINUTE)
    named = line(page, check)
    assert page.good == (verdict != "problem")
    assert named.verdict == verdict
    assert found in named.found
    assert do in named.do


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=slow)])
def test_a_parameter_that_cannot_be_set_is_named_and_left_out(examined: Examine, fmi: int) -> None:
    page = examined("refuses_parameter", fmi)

    assert page.good
    refused = next(each for each in page.findings if "refuses" in each.found)
    assert refused.verdict == "note"
    assert refused.found.startswith("limit: ")
    assert "1 of 1 act on the outputs" in line(page, "parameters").found


@pytest.mark.parametrize(
    ("fmi", "instances"),
    [(2, 1), pytest.param(3, 1, marks=slow), *(pytest.param(i, None, marks=slow) for i in (2, 3))],
)
def test_the_communication_step_with_which_it_can_be_simulated_is_named(
    own_fmu: Give, fmi: int, instances: int | None
) -> None:
    problem = in_co_simulation(bare_problem(own_fmu("needs_short_steps", fmi)))
    page = run_checks(problem, Resources(instances=instances), MINUTE, declared=False)

    assert not page.good
    failed = line(page, "experiment default")
    assert "t = " in failed.found
    assert failed.do.startswith("model.step = 0.01, ")


@pytest.mark.parametrize("name", [pytest.param("leaks", marks=slow), "leaks_on_reset"])
def test_a_leak_has_its_size(examined: Examine, name: str) -> None:
    named = line(examined(name, executor="processes"), "memory")

    assert named.verdict == "note"
    leak = float(named.found.removeprefix("leaks ").partition(" ")[0])
    assert leak == pytest.approx(1024.0, rel=0.05)  # a MiB, and what the allocator adds
    assert "executor.growth" in named.found


@slow
def test_what_there_is_no_time_for_is_said(examined: Examine) -> None:
    page = examined("slow", seconds=3.0)

    assert "not done" in {each.verdict for each in page.findings}
    assert all("--seconds" in each.do for each in page.findings if each.verdict == "not done")


def test_the_communication_step_that_results_depend_on(own_fmu: Give) -> None:
    problem = in_co_simulation(bare_problem(own_fmu("van_der_pol", 2)))
    coarse = looked_at(problem)
    assert re.search("the communication step of .* halved", line(coarse, "accuracy").found)


def test_a_communication_step_that_is_fixed_cannot_be_halved(own_fmu: Give) -> None:
    page = looked_at(in_co_simulation(bare_problem(own_fmu("fixed_step", 2))))
    assert line(page, "accuracy").verdict == "not done"
    assert "cannot be halved" in line(page, "accuracy").found


def test_the_bounds_are_tried(own_fmu: Give) -> None:
    problem = bare_problem(own_fmu("dahlquist", 2))
    known = problem.parameters[0]
    given = Parameter(known.name, known.start, lower=0.1, upper=20.0)
    page = looked_at(replace(problem, parameters=(given,)))

    assert "lower and upper bounds" in line(page, "bounds").found


@pytest.mark.parametrize(
    ("name", "code", "phrase"),
    [
        pytest.param("dahlquist", 0, "no problem was found", marks=slow),
        ("needs_library", 2, "1 problem"),
    ],
)
def test_a_file_alone(own_fmu: Give, name: str, code: int, phrase: str, capsys: Capture) -> None:
    assert main(["check", str(own_fmu(name, 2)), "--seconds", "60"]) == code
    assert phrase in capsys.readouterr().out


def test_a_config_whose_parameter_is_dead(own_fmu: Give, tmp_path: Path, capsys: Capture) -> None:
    times = np.linspace(0.0, 1.0, 11).tolist()
    rows = "".join(f"{t!r},1.0\n" for t in times)
    (tmp_path / "a.csv").write_text(f"time,y\n{rows}", encoding="utf-8")
    config = (
        "parameters.k = { start = 0.7, bounds = [0.01, 10.0] }\n"
        f'parameters.dead.start = 2.0\n[model]\nfmu = "{own_fmu("dead_parameter", 3)}"\n'
        '[[experiments]]\nid = "a"\ndata = "a.csv"\ntime = "time"\noutputs = { y = "y" }\n'
    )
    (tmp_path / "config.toml").write_text(config, encoding="utf-8")

    assert main(["check", str(tmp_path / "config.toml"), "--seconds", "60"]) == 1
    said = capsys.readouterr().out
    assert "parameter dead" in said
    assert "1 of 2 act on the outputs" in said


def test_an_experiment_at_rest_tells_nothing(capsys: Capture) -> None:
    """Nothing moves in exp5: its start is 0, and so is its force."""
    config = ROOT / "configs" / "mass_spring_damper.toml"
    assert main(["check", str(config), "--seconds", "60"]) == 0
    said = capsys.readouterr().out
    assert "3 of 3 act on the outputs" in said
    assert "y changes by 0 of its size" not in said


def test_an_effect_does_not_make_a_check_reset_the_instance(own_fmu: Give) -> None:
    """It simulates twice, because an effect is compiled at first: the second time in a new one."""
    problem = bare_problem(own_fmu("reset_crashes", 2))
    gain = Effect("gain", "output y", "gain")
    strength = Parameter("gain.k", 0.1, -1.0, 1.0)
    whole = replace(problem, effects=(gain,), parameters=(*problem.parameters, strength))
    page = run_checks(whole, Resources(), MINUTE)

    assert line(page, "simulates").verdict == "ok"
    assert line(page, "reset").verdict == "note"
    assert page.good


def test_what_one_process_cannot_repeat_is_not_compared_in_one(examined: Examine) -> None:
    page = examined("process_counter")

    assert "new process for each simulation" in line(page, "reset").do
    assert line(page, "parameters").verdict == "not done"
    assert not [each for each in page.findings if each.check in ("accuracy", "dead parameters")]


def test_sensitivities_are_not_offered_where_a_reset_spoils_them(examined: Examine) -> None:
    page = examined("reset_spoils_directional")

    assert line(page, "reset").verdict == "note"
    assert not [each for each in page.findings if each.check == "sensitivities"]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=slow)])
def test_an_fmu_that_ends_by_itself_is_to_be_stopped_before(own_fmu: Give, fmi: int) -> None:
    problem = bare_problem(own_fmu("stair", fmi))
    (run,) = problem.experiments
    page = looked_at(replace(problem, experiments=(replace(run, stop=12.0),)))

    ended = line(page, "experiment default")
    assert "the FMU ended the simulation by itself at t = 9 s" in ended.found
    assert ended.do == "a config whose experiment has a stop before that time"
