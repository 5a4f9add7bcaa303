"""`cluster-est check` names each misbehaving FMU for what it is, and good ones have no problem."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.described import real, write_fmu
from support.problems.springs import FMU, ROOT
from support.spoiled import spoiled_fmu, write_input

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.cli.answer import PrintedAnswer
from cluster_est.cli.check_command import print_page, print_variables
from cluster_est.errors import ModelError
from cluster_est.preflight.all_checks import costs, run_checks
from cluster_est.preflight.data_checks import data_findings
from cluster_est.preflight.subject import (
    CheckFinding,
    CheckPage,
    CheckSubject,
    CheckVerdict,
    TimeBudget,
    bare_problem,
)
from cluster_est.problem.parameter import Parameter
from cluster_est.running import reset_policy
from cluster_est.running.resources import Resources
from workers.fmu.variable import ModelVariable
from workers.messages import Effect, Solver
from workers.probes.probes import (
    CostProbe,
    DirectionalProbe,
    LeftoverProbe,
    MovementProbe,
    SimulationCost,
)
from workers.process.trial import BenchHere, NoAnswer, ProbeBench

MINUTE = 60.0
"""So much time that nothing is left out on a busy machine."""
HARMLESS = {
    *("thermostat", "van_der_pol", "dead_parameter", "wrong_directional", "zero_directional"),
    *("robertson", "fails_to_reset", "reset_keeps_state", "reset_spoils_directional"),
    *("refuses_parameter", "needs_library", "no_licence", "needs_stop_time"),
}
"""Asked in this process, which a process of their own would only make slower."""


@pytest.fixture
def examined(own_fmu):
    """The page of one of the project's own FMUs."""

    def look(name, fmi=2, seconds=MINUTE, executor="local"):
        problem = bare_problem(own_fmu(name, fmi))
        resources = Resources(executor=executor)
        bench = BenchHere if name in HARMLESS else ProbeBench.open
        return run_checks(problem, resources, seconds, declared=False, open_bench=bench)

    return look


def looked_at(problem):
    """The page of a problem that does no harm to this process."""
    return run_checks(problem, Resources(), MINUTE, open_bench=BenchHere)


def line(page, check):
    return next(each for each in page.findings if each.check == check)


def in_co_simulation(problem, step=None):
    model = replace(problem.model, interface="co_simulation", solver=Solver("fmu", step))
    return replace(problem, model=model)


slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "fmi"),
    [("thermostat", 2), *(pytest.param(n, 3, marks=slow) for n in ("dahlquist", "van_der_pol"))],
)
def test_a_good_fmu(examined, name, fmi):
    page = examined(name, fmi)
    assert page.good
    assert {each.verdict for each in page.findings} == {"ok"}
    assert line(page, "memory").found.startswith("no leak in ")


@pytest.mark.parametrize(
    ("name", "fmi", "check", "verdict", "found", "do"),
    [
        ("reset_keeps_state", 2, "reset", "note", "0.035 of the outputs' size", "model.reset"),
        ("reset_crashes", 2, "reset", "note", "its process crashed (SIGSEGV)", "model.reset"),
        ("fails_to_reset", 2, "values", "note", "survive a reset", "model.reset"),
        (
            "random_output",
            2,
            "repeatable",
            "problem",
            "two simulations in fresh processes differ",
            "method.name",
        ),
        ("once_per_process", 2, "instances", "note", "as the FMU declares", "executor.name"),
        (
            "once_undeclared",
            2,
            "instances",
            "note",
            "although the FMU does not declare this",
            "executor.name",
        ),
        ("shares_static", 2, "instances", "note", "give different results while", "executor.name"),
        (
            "dead_parameter",
            2,
            "dead parameters",
            "note",
            "depend on dead",
            "if the inputs have data",
        ),
        ("wrong_directional", 2, "derivatives", "note", "differ from finite differences", "export"),
        ("zero_directional", 2, "derivatives", "note", "all of them are 0", "export"),
        ("needs_stop_time", 2, "stop time", "note", "only be initialised with", "model.stop_time"),
        pytest.param(
            *("robertson", 2, "stiffness", "note", "is stiff", 'model.solver = "cvode"'), marks=slow
        ),
        ("needs_library", 2, "loads", "problem", "libnobody_has_this.so", ""),
        ("no_licence", 3, "loads", "problem", "no licence for this model", ""),
        ("crashes_at_start", 2, "experiment default", "problem", "crash: ", ""),
        ("hangs_at_start", 2, "experiment default", "problem", "no answer within", ""),
    ],
)
def test_what_is_wrong_is_named(examined, name, fmi, check, verdict, found, do):
    page = examined(name, fmi, seconds=2.0 if name == "hangs_at_start" else MINUTE)
    named = line(page, check)
    assert page.good == (verdict != "problem")
    assert named.verdict == verdict
    assert found in named.found
    assert do in named.do


def test_an_fmu_with_a_clock_is_named(examined, monkeypatch):
    monkeypatch.setattr(reset_policy, "LATER_SECONDS", 1.1)
    page = examined("tells_the_time")
    assert not page.good
    found = [each for each in page.findings if each.verdict == "problem"]
    assert [each.check for each in found] == ["repeatable"]
    assert "differ" in found[0].found
    assert "clock" in found[0].do


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=slow)])
def test_a_parameter_that_cannot_be_set_is_named_and_left_out(examined, fmi):
    page = examined("refuses_parameter", fmi)
    assert page.good
    refused = next(each for each in page.findings if "cannot be set" in each.found)
    assert refused.verdict == "note"
    assert refused.found.startswith("limit: ")
    assert refused.do.startswith("remove from the config what cannot be set")
    assert "1 of 1 parameters affect the outputs" in line(page, "parameters").found


@pytest.mark.parametrize(
    ("fmi", "instances"),
    [(2, 1), pytest.param(3, 1, marks=slow), *(pytest.param(i, None, marks=slow) for i in (2, 3))],
)
def test_the_communication_step_with_which_it_can_be_simulated_is_named(own_fmu, fmi, instances):
    problem = in_co_simulation(bare_problem(own_fmu("needs_short_steps", fmi)))
    page = run_checks(problem, Resources(instances=instances), MINUTE, declared=False)
    assert not page.good
    failed = line(page, "experiment default")
    assert "t = " in failed.found
    assert failed.do.startswith("set model.step = 0.01; ")


@pytest.mark.parametrize("name", [pytest.param("leaks", marks=slow), "leaks_on_reset"])
def test_a_leak_has_its_size(examined, name):
    named = line(examined(name, executor="processes"), "memory")
    assert named.verdict == "note"
    leak = float(named.found.removeprefix("each simulation leaks ").partition(" ")[0])
    assert leak == pytest.approx(1024.0, rel=0.05)  # a MiB, and what the allocator adds
    assert "executor.growth" in named.found


@slow
def test_what_there_is_no_time_for_is_said(examined):
    page = examined("slow", seconds=3.0)
    assert "not done" in {each.verdict for each in page.findings}
    assert all("--seconds" in each.do for each in page.findings if each.verdict == "not done")


@pytest.mark.parametrize(
    ("name", "verdict", "found"),
    [
        ("dahlquist", "ok", "the communication step of .* halved"),
        ("fixed_step", "not done", "cannot be halved"),
    ],
)
def test_the_communication_step_that_results_depend_on(own_fmu, name, verdict, found):
    named = line(looked_at(in_co_simulation(bare_problem(own_fmu(name, 2)))), "accuracy")
    assert named.verdict == verdict
    assert re.search(found, named.found)


def test_the_bounds_are_tried(own_fmu):
    problem = bare_problem(own_fmu("dahlquist", 2))
    known = problem.parameters[0]
    given = Parameter(known.name, known.start, bounds=(0.1, 20.0))
    page = looked_at(replace(problem, parameters=(given,)))
    assert "lower and upper bounds" in line(page, "bounds").found


@pytest.mark.parametrize(
    ("name", "code", "phrase"),
    [
        pytest.param("dahlquist", 0, "no problem was found", marks=slow),
        ("needs_library", 2, "1 problem"),
    ],
)
def test_a_file_alone(own_fmu, name, code, phrase, capsys):
    assert main(["check", str(own_fmu(name, 2)), "--seconds", "60"]) == code
    assert phrase in capsys.readouterr().out


def test_the_variables_of_an_fmu_are_listed_with_their_units(capsys):
    fmu = str(ROOT / "configs" / "models" / "quarter_car.fmu")
    assert main(["check", fmu, "--seconds", "0"]) == 0
    out = capsys.readouterr().out
    for row in (
        r"road +input +m +0 +height of the road",
        r"velocity +output +m/s +measured vertical",
        r"v_wheel +state +m/s +0 +vertical velocity of the wheel",
        r"c_damper +parameter +N\.s/m +1500 +damping of the suspension",
    ):
        assert re.search(f"^{row}", out, re.M)
    assert main(["check", fmu, "--seconds", "0", "--json"]) == 0
    variables = json.loads(capsys.readouterr().out)["variables"]
    assert len(variables) == 12
    assert {"name": "k_tyre", "is": "parameter", "unit": "N/m", "start": 160000.0,
            "text": "stiffness of the tyre"} in variables  # fmt: skip


def test_many_variables_of_an_fmu_are_counted(capsys):
    own = [ModelVariable(f"p{i}", i, "real", "parameter", settable=True) for i in range(50)]
    variables = {each.name: each for each in own}
    print_variables(PrintedAnswer(), SimpleNamespace(variables=variables, outputs=(), states=()))
    out = capsys.readouterr().out
    assert "p39 " in out
    assert "p40 " not in out
    assert "and 10 more parameters; --json lists all of them" in out


def test_a_config_whose_parameter_is_dead(own_fmu, tmp_path, capsys):
    changes = {
        "model.fmu": str(own_fmu("dead_parameter", 2)),
        "parameters": {"k": {"start": 0.7, "bounds": [0.01, 10.0]}, "dead": {"start": 2.0}},
        "values": {},
        "experiments.0.inputs": {},
    }
    assert main(["check", str(write_input(tmp_path, changes)), "--seconds", "60"]) == 1
    said = capsys.readouterr().out
    assert "parameter dead" in said
    assert "1 of 2 parameters affect the outputs" in said


def test_an_experiment_at_rest_tells_nothing(capsys):
    """Nothing moves in exp5: its start is 0, and so is its force."""
    config = ROOT / "configs" / "mass_spring_damper.toml"
    assert main(["check", str(config), "--seconds", "60"]) == 0
    said = capsys.readouterr().out
    assert "3 of 3 parameters affect the outputs" in said
    assert "y changes by 0 of its size" not in said


def test_an_effect_does_not_make_a_check_reset_the_instance(own_fmu):
    """It simulates twice, because SymPy is imported at first: the second time in a new one."""
    problem = bare_problem(own_fmu("reset_crashes", 2))
    gain = Effect("gain", "output y", "gain")
    strength = Parameter("gain.k", 0.1, (-1.0, 1.0))
    whole = replace(problem, effects=(gain,), parameters=(*problem.parameters, strength))
    page = run_checks(whole, Resources(), MINUTE)
    assert line(page, "simulates").verdict == "ok"
    assert line(page, "reset").verdict == "note"
    assert page.good


def test_what_one_process_cannot_repeat_is_not_compared_in_one(examined):
    page = examined("process_counter")
    assert "each simulation can have a new process" in line(page, "reset").do
    assert line(page, "parameters").verdict == "not done"
    assert not [each for each in page.findings if each.check in ("accuracy", "dead parameters")]


def test_sensitivities_are_not_offered_where_a_reset_spoils_them(examined):
    page = examined("reset_spoils_directional")
    assert line(page, "reset").verdict == "note"
    assert not [each for each in page.findings if each.check == "sensitivities"]


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=slow)])
def test_an_fmu_that_ends_by_itself_is_to_be_stopped_before(own_fmu, fmi):
    problem = bare_problem(own_fmu("stair", fmi))
    (run,) = problem.experiments
    page = looked_at(replace(problem, experiments=(replace(run, stop=12.0),)))
    ended = line(page, "experiment default")
    assert "the FMU ended the simulation by itself at t = 9 s" in ended.found
    assert ended.do == "write a config with an experiment that stops before that time"


def parameter(name, reference=0, variability="fixed", start=1):
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

    def __init__(self, answers, *given):
        self.answers, self.bench = answers, BenchHere(*given)

    def ask(self, probe, seconds):
        for (kind, points), answer in self.answers.items():
            if isinstance(probe, kind) and points in (0, len(getattr(probe, "others", ()))):
                return answer
        return self.bench.ask(probe, seconds)

    def close(self):
        self.bench.close()


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    """The mass-spring-damper with bounds, and with directional derivatives as it says."""
    path = tmp_path_factory.mktemp("fmu") / "x.fmu"
    offers = 'providesDirectionalDerivative="true"'
    path.write_bytes(spoiled_fmu(xml={"<ModelExchange ": f"<ModelExchange {offers} "}))
    problem = bare_problem(path)
    given = [Parameter(p.name, p.start, (0.1, 50.0)) for p in problem.parameters]
    return replace(problem, parameters=tuple(given))


def findings(problem, kind, answer, check, points=0):
    """Those of one check where a kind of probe, for so many points, has this answer."""
    quick = {(CostProbe, 0): SimulationCost(1e-3, 0.0, 300)}

    def opened(*given):
        return Answered({**quick, (kind, points): answer}, *given)

    page = run_checks(problem, Resources(), 60.0, declared=False, open_bench=opened)
    return [each for each in page.findings if each.check == check]


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ([0.1], [("ok", "simulated with all parameters at their lower bounds"),
                 ("not done", "not simulated with all parameters at their upper bounds")]),
        ([], [("not done", "not simulated with all parameters at their lower and upper bounds")]),
        (["it stops"], [("note", "at their lower bounds, it stops"),
                        ("not done", "at their upper bounds")]),
        (["it stops", 0.2], [("note", "at their lower bounds, it stops")]),
    ],
)  # fmt: skip
def test_only_bounds_that_were_tried_are_said_to_be_good(spring, answer, expected):
    found = findings(spring, MovementProbe, answer, "bounds", points=2)
    assert [each.verdict for each in found] == [verdict for verdict, _ in expected]
    assert all(said in each.found for each, (_, said) in zip(found, expected, strict=True))


NO_JACOBIAN = SimpleNamespace(error=np.nan, zero=False)


@pytest.mark.parametrize(
    ("kind", "answer", "check", "verdict", "said"),
    [
        (DirectionalProbe, NO_JACOBIAN, "derivatives", "note", "differ"),
        (CostProbe, SimulationCost(1e-3, None, 64), "memory", "not done", "64 simulations are too"),
        (CostProbe, SimulationCost(1e-3, 0.0, 64), "memory", "not done", "64 simulations are too"),
        (CostProbe, SimulationCost(1.1, 0.0, 300), "few simulations", "ok", "are slow"),
        (LeftoverProbe, NoAnswer("it would take 5 s", late=True), "values", "not done", "5 s"),
    ],
)
def test_what_is_not_known_is_not_said_to_be_good(spring, kind, answer, check, verdict, said):
    (found,) = findings(spring, kind, answer, check)
    assert found.verdict == verdict
    assert said in found.found


def test_no_plan_for_few_simulations_where_each_is_quick(spring):
    assert findings(spring, CostProbe, SimulationCost(0.9, 0.0, 300), "few simulations") == []


class Counted(Answered):
    """Simulates in three tenths of a second, as often as a probe has time for."""

    def ask(self, probe, seconds):
        if isinstance(probe, CostProbe):
            self.answers.setdefault("seconds", []).append(probe.seconds)
            return SimulationCost(0.3, 0.0, int(probe.seconds / 0.3))
        return self.bench.ask(probe, seconds)


@pytest.mark.parametrize(("seconds", "enough"), [(60.0, True), (20.0, False)])
def test_time_that_is_left_goes_to_what_had_too_little(spring, monkeypatch, seconds, enough):
    """Nobody is told to give more while most of what was given is left."""
    monkeypatch.setattr("cluster_est.preflight.all_checks.ENOUGH", math.inf)
    asked = {}
    page = run_checks(
        spring,
        Resources(),
        seconds,
        declared=False,
        open_bench=lambda *given: Counted(asked, *given),
    )
    (memory,) = [each for each in page.findings if each.check == "memory"]
    first, again = asked["seconds"]
    assert again > 2.5 * first
    assert (memory.verdict == "ok") is enough
    if not enough:
        more = float(re.search(r"--seconds (\d+)", memory.do)[1])
        assert more >= 2.0 * seconds
    assert sum(each.check == "memory" for each in page.findings) == 1


class Asked(ProbeBench):
    """Answers nothing, and keeps what it was asked last."""

    def ask(self, probe, seconds):
        self.last = probe, seconds
        return NoAnswer("it did not end", late=True)

    def close(self):
        """Nothing was opened."""


def test_with_more_time_each_check_has_more(spring):
    """A tenth of a second a simulation: more seconds must lead to enough of them to see a leak."""
    bench = Asked()

    def allowed(seconds):
        budget = TimeBudget.of(seconds)
        subject = CheckSubject(spring, spring.describe(), bench, budget, simulation_seconds=0.1)
        costs(subject)
        probe, limit = bench.last
        assert isinstance(probe, CostProbe)
        return limit, probe.seconds

    short, long = allowed(4.0), allowed(100.0)
    assert short == pytest.approx((3.0, 1.0), rel=0.1)
    assert long == pytest.approx((33.3, 15.0), rel=0.1)


@pytest.mark.parametrize(
    ("verdicts", "end"),
    [
        (["not done"], "nothing has been checked yet"),
        (
            ["not done", "ok"],
            "1 of 2 checks was not done; result of the others: no problem was found",
        ),
        (
            ["not done"] * 2 + ["problem"],
            "2 of 3 checks were not done; result of the others: 1 problem",
        ),
        (["ok", "note"], "no problem was found; read the 1 note too"),
    ],
)
def test_the_last_line_counts_what_was_done(capsys, verdicts, end):
    found = tuple(CheckFinding(CheckVerdict(each), "x", "y") for each in verdicts)
    print_page(PrintedAnswer(), CheckPage(found, ()))
    assert capsys.readouterr().out.splitlines()[-1] == end


INPUTS = {
    "an integer": ('causality="input"', '<Integer start="0"/>', False),
    "a boolean": ('causality="input"', '<Boolean start="false"/>', False),
    "a discrete one": ('causality="input" variability="discrete"', '<Real start="0"/>', False),
    "a continuous one": ('causality="input"', '<Real start="0"/>', True),
}


@pytest.mark.parametrize("name", INPUTS)
def test_an_input_that_is_held_anyway_makes_no_ramps(tmp_path, name):
    attributes, kind, noted = INPUTS[name]
    u = f'<ScalarVariable name="u" valueReference="7" {attributes}>{kind}</ScalarVariable>'
    fmu = write_fmu(tmp_path, real("y", "output"), real("k", "parameter", start=1.0), u)
    times = 0.1 * np.arange(40)
    steps = np.repeat([0.0, 1.0, 0.0, 1.0], 10)
    columns = {"t": times, "u": steps, "y": np.sin(times)}
    run = ce.Experiment.from_table(columns, id="a", time="t", inputs=["u"], outputs=["y"])
    problem = ce.Problem(ce.read_model(fmu), [ce.Parameter("k", 1.0)], [run])
    assert any("into a ramp" in each for each in problem.notes()) is noted
    with_hole = replace(run.inputs[0], times=np.delete(times, 5), values=np.delete(steps, 5))
    holed = replace(problem, experiments=(replace(run, inputs=(with_hole,)),))
    checks = {each.check for each in data_findings(holed, holed.describe())}
    assert bool({"jumps", "input u"} & checks) is noted


def test_an_fmu_that_was_not_tried_is_said_to_be_that():
    (found,) = run_checks(bare_problem(FMU), Resources(), 0.0, declared=False).findings
    assert found.verdict == "not done"
    assert "nothing was simulated" in found.found
