"""Loops that look for effects in parts of long records."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.loop import ClosedLoop
from cluster_est.closed_loop.outliers import open_checked_workbench
from cluster_est.closed_loop.search_windows import SearchWindows, choose_windows
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, LoopWorkbench, open_workbench
from cluster_est.problem.thinning import IN_PARTS, ThinningSettings, rows_of, thinned
from cluster_est.run_folder.context import ExistingRun, RunContext
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.environment import RunEnvironment
from workers.messages import FloatArray

MOST, NOISE, LIMIT, STOP, LATE = 250, 0.004, 6.0, 60.0, 45.0
TIMES = np.linspace(0.0, STOP, 6001)
FREQUENCIES = (0.37, 0.71, 1.13)
SETTINGS = ce.LoopSettings(
    sites=("input F",), forms=("saturation", "gain"), draws=200, pairs=False, max_effects=1
)
Course = Callable[[FloatArray], FloatArray]


def unchanged(force: FloatArray) -> FloatArray:
    return force


def saturated(force: FloatArray) -> FloatArray:
    return np.clip(force, -LIMIT, LIMIT)


def springs(loud: Course, change: Course = saturated) -> ce.Problem:
    """A mass on a spring, behind something that changes a force of given loudness."""
    spring = missing_effect_problem("mass_spring_damper", signals=())
    runs, forces = [], []
    for e, run in enumerate(spring.experiments):
        waves = sum(np.sin(2.0 * np.pi * f * TIMES + 3.0 * f + e) for f in FREQUENCIES)
        force = 3.0 * loud(TIMES) * waves
        output = ce.Output("y", TIMES, np.zeros(len(TIMES)), NOISE)
        acting = ce.Input("F", TIMES, change(force))
        runs.append(replace(run, stop=STOP, inputs=(acting,), outputs=(output,)))
        forces.append(ce.Input("F", TIMES, force))
    made = measured(replace(spring, experiments=tuple(runs)), NOISE)
    given = [
        replace(run, inputs=(force,)) for run, force in zip(made.experiments, forces, strict=True)
    ]
    return replace(made, experiments=tuple(given))


def loud_at_the_end(times: FloatArray) -> FloatArray:
    return np.where(times > LATE, 1.4, 0.6)


def always_loud(times: FloatArray) -> FloatArray:
    return np.ones(len(times))


@pytest.fixture(scope="module")
def late() -> ce.Problem:
    return springs(loud_at_the_end)


@contextmanager
def thinned_bench(problem: ce.Problem) -> Iterator[LoopWorkbench]:
    thin = thinned(problem, MOST)
    request = LoopRequest(thin.problem, settings=SETTINGS, noise_of_samples=thin.noise)
    with open_workbench(request) as bench:
        yield bench


@pytest.fixture(scope="module")
def chosen(late) -> SearchWindows:
    with thinned_bench(late) as bench:
        windows = choose_windows(bench.fitter, MOST)
    assert windows is not None
    return windows


def looped(problem: ce.Problem, rows: int) -> ce.LoopResult:
    return ce.close_loop(problem, settings=SETTINGS, thinning=ThinningSettings(rows=rows))


@pytest.fixture(scope="module")
def found(late) -> ce.LoopResult:
    return looped(late, MOST)


def test_an_effect_that_acts_late_is_found_where_it_acts(found):
    result = found
    assert result.verdict is Verdict.FOUND
    (effect,) = result.effects
    assert effect.effect.form == "saturation"
    assert effect.coefficients[0].value == pytest.approx(LIMIT, rel=0.01)
    assert "'e0' from 45.02 to 60 s" in result.notes[0]
    assert "where the error of the declared model is largest" in result.notes[0]
    assert "in the whole records" not in result.notes[0]
    # what is reported is of all rows, and has nothing of the parts' own
    assert [len(run.outputs[0].times) for run in result.problem.experiments] == [len(TIMES)] * 2
    assert len(result.fun) == 2 * len(TIMES)
    assert [e.label for e in result.after.estimates] == ["m", "k", "c", "saturation_F.limit"]


def test_an_effect_that_acts_throughout_is_looked_for_in_the_beginnings():
    result = looped(springs(always_loud), MOST)
    assert [effect.effect.form for effect in result.effects] == ["saturation"]
    assert "in 15 s of each of 2 records, from the beginning; estimates" in result.notes[0]


def test_whole_records_are_searched_where_nothing_is_found_in_parts():
    result = looped(springs(always_loud, unchanged), MOST)
    assert result.verdict is Verdict.NONE
    assert "whole records, because no effect was found in the parts;" in result.notes[0]


def test_shorter_records_stay_whole(late):
    rows = rows_of(thinned(late, MOST).problem.experiments[0])
    enough = rows // IN_PARTS + 1
    with thinned_bench(late) as bench:
        assert choose_windows(bench.fitter, enough) is None
        assert choose_windows(bench.fitter, None) is None


def test_a_part_goes_on_from_where_its_record_stands(late, chosen):
    part, whole = chosen.problem.experiments[0], chosen.whole.experiments[0]
    assert (part.start, part.stop, part.record_id) == (chosen.windows[0].start, STOP, "e0")
    assert {own.variable for own in part.own_starts} == {"x", "v"}
    assert rows_of(part) < 0.5 * rows_of(whole)
    elsewhere = tuple(replace(own, start=own.start + 1.0) for own in part.own_starts)
    moved = (replace(part, own_starts=elsewhere), *chosen.problem.experiments[1:])
    wrong = replace(chosen, problem=replace(chosen.problem, experiments=moved))
    for windows, said in (
        (chosen, ""),
        (wrong, "does not continue correctly from the beginning of a part"),
    ):
        with open_workbench(LoopRequest(windows.problem, settings=SETTINGS)) as bench:
            assert windows.unlike_records(bench.fitter).endswith(said)
            assert bool(windows.unlike_records(bench.fitter)) is bool(said)


def test_what_acts_outside_of_the_parts_alone_is_noticed(late, chosen):
    with thinned_bench(late) as bench:
        assert chosen.missed(bench.fitter, chosen.fitted) == ""
        early = []
        for window, item in zip(chosen.windows, bench.fitter.records.items, strict=True):
            rows = item.rows.start + np.flatnonzero(item.times <= 15.0)
            early.append(replace(window, start=0.0, stop=15.0, rows=rows))
        said = replace(chosen, windows=tuple(early)).missed(bench.fitter, chosen.fitted)
    assert said.startswith("the model that was found in the parts leaves more error in 'e")
    assert said.endswith("to 60 s")


def test_a_search_in_parts_that_is_stopped_goes_on_to_the_same_result(late, found, tmp_path):
    identity = RunIdentity(RunKind.CLOSED_LOOP, late, "# no config\n", "", 0)
    study = ClosedLoop(late, SETTINGS, thinning=ThinningSettings(rows=MOST))

    def run(existing, told):
        context = RunContext(identity, tmp_path / "run", existing, lambda _: None)
        kept = context.monitor(lambda _: None)
        monitor = replace(kept, record=lambda *simulated: told(kept.record, *simulated))
        with context:
            return study.run(RunEnvironment(monitor=monitor, earlier=context.earlier))

    def stop_in_refits(record, origin, outcome):
        record(origin, outcome)
        if origin.search == LoopStage.REFITS.value:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(ExistingRun.REFUSE, stop_in_refits)
    resumed = run(ExistingRun.RESUME, lambda record, *simulated: record(*simulated))
    assert (resumed.verdict, resumed.x, resumed.notes) == (found.verdict, found.x, found.notes)
    np.testing.assert_array_equal(resumed.fun, found.fun)


def test_a_row_of_many_samples_is_no_outlier(late):
    """Outliers were looked for in the samples; a row that stands alone is where outputs move."""
    thin = thinned(late, MOST)
    runs = list(thin.problem.experiments)
    (output,) = runs[0].outputs
    values = output.values.copy()
    values[len(values) // 2] += 60.0 * NOISE
    runs[0] = replace(runs[0], outputs=(replace(output, values=values),))
    spiked = replace(thin.problem, experiments=tuple(runs))
    request = LoopRequest(spiked, settings=SETTINGS, noise_of_samples=thin.noise)
    left = []
    for made in ((), thin.thinned_outputs):
        with open_checked_workbench(request, thinned=made) as bench:
            left.append(len(bench.fitter.problem.experiments[0].outputs[0].times))
    assert left == [len(values) - 1, len(values)]
