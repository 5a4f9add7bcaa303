"""`cluster-est check` finds what users get wrong in their data, and says the likely mistake."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.preflight import CheckFinding, CheckPage, run_checks
from cluster_est.running.resources import Resources

MODELS = ROOT / "configs" / "models"
MINUTE = 60.0
RPM = 30.0 / np.pi
TIMES = np.arange(401) * 0.005
VOLTS = np.where(TIMES < 0.1, 0.0, np.where(TIMES < 1.0, 6.0, 9.0))
MOTOR = {"R": 1.0, "L": 0.01, "K": 0.06, "J": 5e-4, "b": 2e-4}


def motor(times: np.ndarray, volts: np.ndarray) -> dict[str, np.ndarray]:
    """The DC motor's current and speed by small steps of Euler, with a K of its own."""
    fine = 50
    state, found = np.zeros(2), []
    for i, t in enumerate(times):
        found.append(state.copy())
        step = (times[min(i + 1, len(times) - 1)] - t) / fine
        for _ in range(fine):
            i_, w = state
            state = state + step * np.array(
                [
                    (volts[i] - MOTOR["R"] * i_ - MOTOR["K"] * w) / MOTOR["L"],
                    (MOTOR["K"] * i_ - MOTOR["b"] * w) / MOTOR["J"],
                ]
            )
    current, speed = np.array(found).T
    return {"t": times, "V": volts, "i": current, "w": speed}


TRUTH = motor(TIMES, VOLTS)
HELD = {"V": {"column": "V", "interpolation": "hold"}}


def experiment(columns: Mapping[str, np.ndarray], **changes: object) -> ce.Experiment:
    given = {
        "id": "run",
        "time": "t",
        "inputs": {"V": "V"},
        "outputs": {"current": "i", "speed": "w"},
    }
    return ce.Experiment.from_table(dict(columns), **(given | changes))  # type: ignore[arg-type]


def problem(*runs: ce.Experiment, fmu: str = "dc_motor", names: str = "R K J") -> ce.Problem:
    model = ce.read_model(MODELS / f"{fmu}.fmu", names.split())
    starts = {v.name: v.start for v in ce_variables(fmu)}
    parameters = [ce.Parameter(name, starts[name] or 0.0) for name in names.split()]
    return ce.Problem(model, parameters, list(runs))


def ce_variables(fmu: str):
    from workers.fmu.description import describe

    path = MODELS / f"{fmu}.fmu"
    return describe(path.name, path.read_bytes()).variables.values()


def page(*runs: ce.Experiment, **how: str) -> CheckPage:
    return run_checks(problem(*runs, **how), Resources(), MINUTE)


def lines(found: CheckPage, check: str) -> list[CheckFinding]:
    return [each for each in found.findings if each.check == check]


def line(found: CheckPage, check: str) -> CheckFinding:
    (only,) = lines(found, check)
    return only


def alarms(found: CheckPage) -> list[CheckFinding]:
    return [each for each in found.findings if each.verdict != "ok"]


def test_data_as_the_model_wants_them_raise_no_alarm():
    assert alarms(page(experiment(TRUTH, inputs=HELD))) == []


class TestUnits:
    def test_a_speed_in_rpm_is_named(self):
        found = line(page(experiment(TRUTH | {"w": TRUTH["w"] * RPM})), "unit of speed")
        assert found.verdict == "note"
        assert "1 rad/s is 9.549 rpm: the column seems to be in rpm" in found.found
        assert "times as large as the simulated ones" in found.found
        assert found.do.startswith("columns.COLUMN = { factor = 0.104719755")

    def test_degrees_are_named(self):
        angle = 0.4 * np.cos(np.sqrt(20.0) * TIMES) * np.exp(-0.2 * TIMES)
        columns = {"t": TIMES, "a": np.rad2deg(angle), "m": 0.0 * TIMES}
        run = experiment(columns, inputs={"torque": "m"}, outputs={"y": "a"}, values={"angle": 0.4})
        found = line(page(run, fmu="pendulum", names="J G b"), "unit of y")
        assert "1 rad is 57.3 deg: the column seems to be in deg" in found.found

    @pytest.mark.parametrize("column", ["y_core", "y_case"])
    def test_kelvins_are_named_by_their_offset(self, column):
        times = np.arange(200) * 10.0
        rise = 25.0 + 5.0 * (1.0 - np.exp(-times / 600.0))
        columns = {"t": times, "P": 3.0 + 0.0 * times, "T": rise + 273.15}
        run = experiment(columns, inputs={"P": "P"}, outputs={column: "T"})
        found = line(page(run, fmu="thermal_two_node", names="C_core C_case"), f"unit of {column}")
        assert "as K and degC differ: the column seems to be in K" in found.found
        assert found.do.startswith("columns.COLUMN = { factor = 1, offset = -273.15 }")

    def test_an_input_in_millivolts_is_named(self):
        found = line(page(experiment(TRUTH | {"V": VOLTS * 1e3})), "unit of V")
        assert "the column seems to be in mV, and the FMU counts in V" in found.found
        assert "of what the outputs move by, in place of" in found.found

    def test_a_start_that_is_far_off_is_no_evidence(self):
        """The gain of the motor is wrong by a factor of three."""
        run = experiment(TRUTH | {"w": TRUTH["w"] * 3.0}, inputs=HELD)
        assert [each.check for each in alarms(page(run))] == []


class TestTime:
    @pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 1e3), ("minutes", 1 / 60.0)])
    def test_its_unit_is_named(self, unit, factor):
        found = line(page(experiment(TRUTH | {"t": TIMES * factor})), "time")
        assert f"the time seems to be in {unit}, and is read as {2.0 * factor:.4g} s" in found.found
        assert found.do.startswith(f"columns.COLUMN = {{ factor = {1.0 / factor:g} }}")

    def test_one_of_a_model_that_swings_is_named_though_its_phase_is_off(self):
        """Twenty periods, whose frequency is off by a tenth at the start values."""
        times = np.arange(2500) * 0.016
        angle = 0.3 * np.cos(1.1 * np.sqrt(20.0) * times)
        columns = {"t": times * 1e3, "a": angle, "m": 0.0 * times}
        run = experiment(columns, inputs={"torque": "m"}, outputs={"y": "a"}, values={"angle": 0.3})
        found = line(page(run, fmu="pendulum", names="J G b"), "time")
        assert "the time seems to be in milliseconds, and is read as 3.998e+04 sec" in found.found
        assert "where the FMU's own experiment takes 20 seconds: only then does" in found.found

    def test_a_long_record_of_a_slow_system_is_no_alarm(self):
        times = np.arange(4000) * 30.0
        rise = 25.0 + 12.0 * (1.0 - np.exp(-times / 900.0))
        run = experiment(
            {"t": times, "P": 3.0 + 0.0 * times, "T": rise},
            inputs={"P": "P"},
            outputs={"y_core": "T"},
        )
        found = page(run, fmu="thermal_two_node", names="C_core C_case")
        assert lines(found, "time") == []


class TestInputsWithoutData:
    def test_it_is_said_once_and_not_as_dead_parameters(self):
        run = experiment(TRUTH, inputs={})
        found = page(run)
        assert line(found, "input V").found == "has no data: it stays at 0 V"
        assert line(found, "input V").do.startswith('inputs.V = "COLUMN", or values.V = NUMBER')
        said = lines(found, "parameters")[0].found
        assert said == (
            "the outputs do not depend on R, K, J while input V has no data and stays at 0 V"
        )
        assert not [each for each in found.findings if "is dead" in each.found]

    def test_one_that_another_experiment_has_is_no_alarm(self):
        runs = [experiment(TRUTH), experiment(TRUTH, id="coast", inputs={}, values={"w": 50.0})]
        found = page(*runs)
        assert line(found, "input V").verdict == "ok"
        assert line(found, "input V").found == (
            "has no data in 1 of 2 experiments: it stays at 0 V there"
        )

    def test_a_known_value_is_data(self):
        assert lines(page(experiment(TRUTH, inputs={}, values={"V": 6.0})), "input V") == []


class TestGaps:
    def test_their_number_and_the_longest_are_said(self):
        volts = VOLTS.copy()
        volts[[50, *range(100, 160)]] = np.nan
        found = line(page(experiment(TRUTH | {"V": volts})), "input V")
        assert found.verdict == "note"
        assert found.found == (
            "61 of 401 samples are missing in experiment run and are bridged; the longest gap is "
            "0.305 s, from 0.495 to 0.8 s"
        )
        assert "interpolation" in found.do

    @pytest.mark.parametrize("how", ["slower", "held", "absent rows"])
    def test_what_is_sampled_otherwise_has_none(self, how):
        columns, changes = dict(TRUTH), {}
        if how == "slower":
            columns["V"] = np.where(np.arange(401) % 4 == 0, VOLTS, np.nan)
        elif how == "held":
            columns["V"] = np.where(np.isin(np.arange(401), [0, 20, 200]), VOLTS, np.nan)
            changes = {"inputs": {"V": {"column": "V", "interpolation": "hold"}}}
        else:
            kept = np.r_[0:100, 200:401]
            columns = {name: values[kept] for name, values in columns.items()}
        assert lines(page(experiment(columns, **changes)), "input V") == []

    def test_the_beginning_counts(self):
        volts = np.where(TIMES < 0.2, np.nan, VOLTS)
        found = line(page(experiment(TRUTH | {"V": volts})), "input V")
        assert "40 of 401 samples are missing" in found.found
        assert "the longest gap is 0.2 s, from 0 to 0.2 s" in found.found


def test_an_input_that_jumps_and_is_no_ramp_is_named():
    found = line(page(experiment(TRUTH)), "jumps")
    assert found.verdict == "note"
    assert found.found.startswith("input V keeps its value and jumps 2 times; straight lines")
    assert found.do.startswith('inputs.V = { column = "COLUMN", interpolation = "hold" }')


class TestRounding:
    """An encoder of 256 lines and a sigma that was taken from its data sheet."""

    @pytest.mark.parametrize(("sigma", "said"), [(0.01, True), (0.2, False)])
    def test_steps_above_sigma_are_said(self, sigma, said):
        rounded = np.round(TRUTH["w"] / 0.25) * 0.25
        found = lines(
            page(experiment(TRUTH | {"w": rounded}, sigma={"speed": sigma})), "output speed"
        )
        assert bool(found) is said
        if said:
            assert found[0].verdict == "note"
            assert found[0].found == (
                "its values in experiment run are whole steps of 0.25: rounding alone makes an "
                "error of 0.0722, 7.2 times the sigma that is given"
            )
            assert "0.0722 or more" in found[0].do


class TestStart:
    def test_an_equilibrium_is_named(self):
        coasting = {"t": TIMES, "V": 0.0 * TIMES, "w": 80.0 * np.exp(-2.0 * TIMES)}
        run = experiment(coasting, outputs={"speed": "w"})
        found = line(page(run), "start")
        assert found.found.startswith(
            "nothing moves in the simulation of experiment run: its start is an equilibrium; the "
            "measured speed moves by 78.5 rad/s"
        )
        assert 'parameters.i = { start = 0, per = "experiment" }' in found.do

    def test_one_whose_start_is_estimated_may_begin_there(self):
        coasting = {"t": TIMES, "V": 0.0 * TIMES, "w": 80.0 * np.exp(-2.0 * TIMES)}
        run = experiment(coasting, outputs={"speed": "w"})
        given = problem(run)
        given = replace(
            given,
            model=replace(given.model, parameters=(*given.model.parameters, "w")),
            parameters=(*given.parameters, ce.Parameter("w", 0.0)),
        )
        assert lines(run_checks(given, Resources(), MINUTE), "start") == []

    def test_noise_at_rest_is_rest(self):
        noise = np.random.default_rng(0).normal(size=401)
        run = experiment({"t": TIMES, "V": 0.0 * TIMES, "w": noise}, outputs={"speed": "w"})
        assert lines(page(run), "start") == []


LAST = 'id = "b"\noutputs.current = ""'


class TestSigma:
    @pytest.fixture
    def said(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        def call(defaults: str, *experiments: str) -> str:
            rows = np.column_stack([TRUTH[name] for name in ("t", "V", "i", "w")])
            np.savetxt(
                tmp_path / "a.csv", rows, delimiter=",", header="t,V,i,w", comments="", fmt="%.17g"
            )
            text = (
                f'[model]\nfmu = "{MODELS / "dc_motor.fmu"}"\n[parameters]\nK.start = 0.05\n'
                "[experiment_defaults]\n"
                'time = "t"\ndata = "a.csv"\ninputs.V = "V"\n'
                f'outputs = {{ current = "i", speed = "w" }}\n{defaults}\n'
            )
            text += "".join(f"[[experiments]]\n{each}\n" for each in experiments)
            (tmp_path / "c.toml").write_text(text, encoding="utf-8")
            assert main(["check", str(tmp_path / "c.toml"), "--seconds", "0"]) == 0
            return " ".join(capsys.readouterr().out.split())

        return call

    def test_one_output_without_is_named(self, said):
        found = said("sigma.speed = 0.5", 'id = "a"')
        assert "sigma is given for speed but not for current, where it then is 1 A" in found
        assert "-> sigma.current = NUMBER, the standard deviation of its noise" in found

    def test_one_experiment_without_is_named(self, said):
        found = said("", 'id = "a"\noutputs.current = ""\nsigma.speed = 0.5', LAST)
        assert "sigma is given for speed in experiment a but not in experiment b" in found

    @pytest.mark.parametrize("defaults", ["", "sigma = { speed = 0.5, current = 0.1 }"])
    def test_all_or_none_is_fine(self, said, defaults):
        assert "sigma" not in said(defaults, 'id = "a"')


class TestAccuracy:
    def test_its_error_is_compared_with_the_noise(self):
        given = problem(experiment(TRUTH, sigma={"speed": 0.5, "current": 0.01}))
        solver = ce.Solver("rk4", step=0.01)
        coarse = replace(given, model=replace(given.model, solver=solver))
        found = line(run_checks(coarse, Resources(), MINUTE), "accuracy")
        assert found.verdict != "ok"
        assert "of sigma.current, which is not small against the noise" in found.found
        fine = line(run_checks(given, Resources(), MINUTE), "accuracy")
        assert fine.verdict == "ok"
        assert "of sigma." in fine.found
