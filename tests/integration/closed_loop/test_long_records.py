"""Loops on records that are thinned while effects are looked for, and what is kept on the way."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, waves

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.loop import ClosedLoop
from cluster_est.html_report.reported_run import read_run
from cluster_est.problem.thinning import MOST_ROWS, ThinningSettings, thinned
from cluster_est.run_folder.context import ExistingRun, RunContext
from cluster_est.run_folder.log_segment import read_log
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.environment import Monitor, RunEnvironment
from workers.messages import FloatArray

ROWS, NOISE, WIDTH, LATE = 6001, 0.01, 1.0, 0.003
TIMES = np.linspace(0.0, 6.0, ROWS)
SETTINGS = ce.LoopSettings(
    sites=("input F",), forms=("dead_zone", "delay"), draws=200, pairs=False, max_effects=1
)
Course = Callable[[FloatArray], FloatArray]


def past_dead_zone(force: FloatArray) -> FloatArray:
    return np.sign(force) * np.maximum(np.abs(force) - WIDTH, 0.0)


def delayed(force: FloatArray) -> FloatArray:
    return np.interp(TIMES - LATE, TIMES, force)


def long_springs(change: Course) -> ce.Problem:
    """A mass on a spring at 1 kHz, behind something that changes the force."""
    spring = missing_effect_problem("mass_spring_damper", signals=())
    runs, forces = [], []
    for e, run in enumerate(spring.experiments):
        force = 6.0 * (1.0 + 0.4 * e) * waves(TIMES, float(e))
        output = ce.Output("y", TIMES, np.zeros(ROWS), NOISE)
        acting = ce.Input("F", TIMES, change(force))
        runs.append(replace(run, inputs=(acting,), outputs=(output,)))
        forces.append(ce.Input("F", TIMES, force))
    made = measured(replace(spring, experiments=tuple(runs)), NOISE)
    given = [
        replace(run, inputs=(force,)) for run, force in zip(made.experiments, forces, strict=True)
    ]
    return replace(made, experiments=tuple(given))


@pytest.fixture(scope="module")
def problem() -> ce.Problem:
    return long_springs(past_dead_zone)


@pytest.fixture(scope="module")
def found(problem):
    return ce.close_loop(problem, settings=SETTINGS)


def test_what_is_found_on_thinned_records_is_confirmed_on_all_rows(found):
    result = found
    assert result.verdict is Verdict.FOUND
    (effect,) = result.effects
    assert effect.effect.form == "dead_zone"
    assert effect.coefficients[0].value == pytest.approx(WIDTH, rel=0.02)
    assert [len(run.outputs[0].times) for run in result.problem.experiments] == [ROWS, ROWS]
    assert len(result.fun) == 2 * ROWS
    assert result.notes[0].startswith("long records are thinned from")
    assert result.noise["y"] == pytest.approx(NOISE, rel=0.1)


def test_a_delay_that_is_shorter_than_the_steps_of_thinned_records_is_found():
    problem = long_springs(delayed)
    steps = np.diff(thinned(problem, MOST_ROWS).problem.experiments[0].outputs[0].times)
    assert np.median(steps) > LATE
    result = ce.close_loop(problem, settings=SETTINGS)
    assert result.verdict is Verdict.FOUND
    (effect,) = result.effects
    assert effect.effect.form == "delay"
    assert effect.coefficients[0].value == pytest.approx(LATE, rel=0.1)
    assert result.notes[0].startswith("long records are thinned from")


def test_no_rows_are_left_out_where_that_is_not_wanted(problem):
    settings = SETTINGS.model_copy(update={"draws": 100})
    result = ce.close_loop(problem, settings=settings, thinning=ThinningSettings(rows="no"))
    assert result.verdict is Verdict.FOUND
    assert not any("thinned" in note for note in result.notes)


def test_a_loop_that_is_stopped_leaves_what_its_last_round_has_found(problem, tmp_path):
    out = tmp_path / "run"
    identity = RunIdentity(RunKind.CLOSED_LOOP, problem, "# no config\n", "", 0)
    context = RunContext(identity, out, ExistingRun.REFUSE, lambda _: None)
    kept = context.monitor(lambda _: None)

    def keep_and_stop(result):
        kept.reached(result)
        raise KeyboardInterrupt

    monitor = Monitor(kept.record, kept.show, kept.note, kept.reset, keep_and_stop)
    study = ClosedLoop(problem, SETTINGS)
    with pytest.raises(KeyboardInterrupt), context:
        study.run(RunEnvironment(monitor=monitor))
    run = read_run(out)
    assert (run.status, run.facts["verdict"]) == ("interrupted", "partial")
    assert run.facts["summary"].startswith("the search stopped after round 1 of at most 1")
    assert [effect["form"] for effect in run.facts["effects"]] == ["dead_zone"]
    assert run.finished
    assert len(run.tables["errors"]) == len(problem.experiments)


def test_a_loop_that_is_stopped_in_its_last_fits_goes_on_to_the_same_result(
    problem, found, tmp_path
):
    out = tmp_path / "run"
    identity = RunIdentity(RunKind.CLOSED_LOOP, problem, "# no config\n", "", 0)
    study = ClosedLoop(problem, SETTINGS, thinning=ThinningSettings(rows="auto"))

    def run(existing, told):
        context = RunContext(identity, out, existing, lambda _: None)
        kept = context.monitor(lambda _: None)
        monitor = replace(kept, record=lambda *simulated: told(kept.record, *simulated))
        with context:
            result = study.run(RunEnvironment(monitor=monitor, earlier=context.earlier))
            context.finish(result)
        return result

    def stop_on_all_rows(record, origin, outcome):
        record(origin, outcome)
        if origin.purpose == "jacobian" and len(outcome.residuals) == ROWS:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(ExistingRun.REFUSE, stop_on_all_rows)
    assert read_run(out).facts["verdict"] == "partial"
    lengths = pc.list_value_length(read_log(out / "evaluations")["residuals"])
    assert 0 < pc.max(lengths).as_py() < ROWS  # of all rows the log keeps hashes alone

    resumed = run(ExistingRun.RESUME, lambda record, *simulated: record(*simulated))
    assert (resumed.verdict, resumed.x) == (found.verdict, found.x)
    np.testing.assert_array_equal(resumed.fun, found.fun)
