from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.springs import TRUE, spring_problem
from support.truth.exact_linear import position

import cluster_est as ce
from cluster_est.html_report.curve_section import broken_line
from cluster_est.html_report.scales import Scale
from cluster_est.preflight.table_columns import read_columns
from cluster_est.problem.gaps import split_at_gaps
from cluster_est.problem.search_space import make_space
from cluster_est.problem.tables.gaps import (
    RecordGap,
    gap_findings,
    input_gaps,
    long_steps,
    output_gaps,
)
from cluster_est.running.environment import RunEnvironment
from cluster_est.sensitivity.analysis import check_bounds
from cluster_est.shooting.carried_states import check_begin, with_carried_states
from workers.fmu.description import describe_model
from workers.messages import Curve, Experiment, Input, Output, Trajectory

STEP = 0.02
TIMES = STEP * np.arange(300)
HOLE = (TIMES > 2.0) & (TIMES < 3.0)
NOISE = 0.003


def never(_name):
    return False


def moving(times=TIMES):
    return 3.0 * np.sin(2.0 * times) + np.where(np.sin(times) > 0.2, 2.0, 0.0)


def record(force, missing=HOLE, interpolation="linear", times=TIMES, **more):
    """A record of the spring with rows missing, simulated as a whole before."""
    y = position(times, force, **TRUE, x0=0.1, v0=0.0)
    y = y + NOISE * np.random.default_rng(0).normal(size=len(times))
    seen = Output("y", times[~missing], y[~missing], sigma=NOISE)
    driving = Input("F", times[~missing], force[~missing], interpolation)
    return Experiment("run", 0.0, float(times[-1]), (driving,), (seen,), **more)


def problem(*experiments, solver=None):
    interface = "co_simulation" if solver else "model_exchange"
    own = spring_problem(experiments=1, interface=interface, solver=solver).problem
    return replace(own, experiments=experiments)


@pytest.mark.parametrize(
    "steps",
    [
        np.full(50, 0.1),
        0.1 * (1.0 + 0.4 * np.random.default_rng(1).uniform(-1.0, 1.0, 300)),
        np.random.default_rng(2).exponential(0.1, 1000),
        np.r_[np.full(400, 0.01), np.full(30, 1.0)],  # another rate
        np.r_[np.full(20, 0.01), np.full(20, 10.0)],
        np.r_[np.full(50, 0.1), 0.4, np.full(50, 0.1)],  # three samples that were lost
        np.r_[1.0, 50.0, 1.0],  # too few to tell
        np.geomspace(0.01, 10.0, 40),
    ],
)
def test_steps_that_are_no_gaps(steps):
    assert len(long_steps(np.cumsum(steps))) == 0


@pytest.mark.parametrize("unit", [1e-6, 1.0, 86400.0])
def test_a_long_step_is_a_gap_in_any_unit(unit):
    times = unit * TIMES[~HOLE]
    assert long_steps(times) == pytest.approx(unit * np.array([[2.0, 3.0]]))


def test_gaps_between_few_rows_are_all_found():
    times = np.delete(np.arange(200.0), np.r_[50:70, 75:100])
    assert long_steps(times).tolist() == [[49.0, 70.0], [74.0, 100.0]]


@pytest.mark.parametrize(
    ("force", "how", "moves"),
    [
        (moving(), "linear", True),
        (np.zeros(300), "linear", False),
        (0.5 * TIMES, "linear", False),
        (0.5 * TIMES, "hold", True),
        (np.where(TIMES < 0.5, 1.0, 2.0), "hold", False),
        (np.where(TIMES < 2.5, 1.0, 2.0), "linear", True),
        (np.where(TIMES < 2.5, TIMES, 5.0 - TIMES), "linear", True),  # a peak in the gap
        (np.where((TIMES < 1.7) | (TIMES > 3.3), 1.0, 0.0), "linear", True),  # short rest
        (np.sin(0.4 * np.pi * (TIMES - 2.5) + 0.5 * np.pi), "linear", True),  # the same level
        (1.0 + 0.001 * np.random.default_rng(0).normal(size=300) + 2.0 * (TIMES < 0.5),
         "linear", False),
        (np.random.default_rng(0).normal(size=300), "linear", True),
    ],
)  # fmt: skip
def test_whether_an_input_may_have_moved_in_a_gap(force, how, moves):
    (gap,) = input_gaps(record(force, interpolation=how), never)
    assert (gap.first, gap.last, gap.whole) == (pytest.approx(2.0), pytest.approx(3.0), True)
    assert gap.moving == (("F",) if moves else ())


def test_an_input_that_is_noted_at_its_changes_has_no_gaps():
    run = record(moving())
    changes = np.r_[np.arange(0.0, 2.0, 0.137), np.arange(4.0, 5.0, 0.137)]
    noted = Input("F", changes, np.arange(len(changes), dtype=float), "hold")
    assert input_gaps(replace(run, inputs=(noted,)), never) == []
    sampled = replace(noted, interpolation="linear")
    assert len(input_gaps(replace(run, inputs=(sampled,)), never)) == 1


def test_a_course_of_straight_lines_with_few_points_has_no_gaps():
    run = record(moving(), missing=np.zeros(300, bool))
    points = np.cumsum(np.r_[np.tile([0.01, 0.2], 8), 3.0, np.tile([0.01, 0.2], 3)])
    course = Input("F", points, np.random.default_rng(0).normal(size=len(points)))
    assert input_gaps(replace(run, inputs=(course,)), never) == []


def forward(force, amount=1.0, at=150):
    """A record whose clock was set forward; no rows are missing."""
    run = record(force, missing=np.zeros(300, bool))
    times = np.where(np.arange(300) < at, TIMES, TIMES + amount)
    (given,), (seen,) = run.inputs, run.outputs
    return replace(
        run,
        stop=float(times[-1]),
        inputs=(replace(given, times=times),),
        outputs=(replace(seen, times=times),),
    )


@pytest.mark.parametrize("force", [3.0 * np.sin(2.0 * TIMES), np.zeros(300)])
def test_a_clock_that_was_set_forward_is_named_with_the_key(force):
    ((_, do, _),) = gap_findings(split_at_gaps(problem(forward(force))).gaps)
    assert "the clock was set forward (the other rows are 0.02 s apart" in do
    assert "give sample_time = 0.02, the seconds between rows, instead of time" in do


def test_a_record_without_inputs_may_also_have_a_clock_that_was_set_forward():
    (seen,) = forward(np.zeros(300)).outputs
    (gap,) = output_gaps("run", [seen], seen.times, None, None)
    assert gap.row_step == pytest.approx(STEP)
    (gap,) = output_gaps("run", [seen], np.r_[seen.times[:150], 3.5, seen.times[150:]], None, None)
    assert gap.row_step == 0.0


@pytest.mark.parametrize("drawn", range(5))
def test_missing_rows_are_not_called_a_clock(drawn):
    force = np.repeat(np.random.default_rng(drawn).normal(size=30), 10)
    for run in (record(moving()), record(force)):
        (_, do, _), *_ = gap_findings(split_at_gaps(problem(run)).gaps)
        assert "clock" not in do


def test_uneven_rows_are_not_advised_to_get_a_sample_time():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 6.0, 300))
    run = forward(np.zeros(300))
    times = np.where(np.arange(300) < 150, times, times + 3.0)
    uneven = [replace(each, times=times) for each in (*run.inputs, *run.outputs)]
    run = replace(run, start=times[0], stop=times[-1], inputs=(uneven[0],), outputs=(uneven[1],))
    (gap,) = input_gaps(run, never)
    assert gap.row_step == 0.0


def test_a_record_without_gaps_is_the_same_object():
    whole = problem(record(moving(), missing=np.zeros(300, bool)))
    assert split_at_gaps(whole) is whole


def test_what_is_behind_a_gap_begins_with_states_of_its_own():
    split = split_at_gaps(problem(record(moving())))
    first, behind = split.experiments
    assert (first.id, first.start, first.stop) == ("run", 0.0, pytest.approx(2.0))
    assert behind.id == "run from 3 s"
    assert (behind.start, behind.record_id) == (pytest.approx(3.0), "run")
    assert first.size + behind.size == int((~HOLE).sum())
    assert behind.inputs[0].times[0] == pytest.approx(3.0)
    space = make_space(split, (0, 1))
    labels = {unknown.label: unknown for unknown in space.unknowns}
    assert set(labels) == {"m", "k", "c", "x0[run]", "x0[run from 3 s]", "v[run from 3 s]"}
    later = labels["x0[run from 3 s]"].parameter
    assert (later.lower, later.upper, later.prior) == (-np.inf, np.inf, None)
    assert split.model.parameters == ("m", "k", "c", "x", "v")
    assert split_at_gaps(split) == split


def test_a_record_with_several_gaps_and_one_beside_it():
    missing = HOLE | ((TIMES > 4.0) & (TIMES < 4.5))
    whole = replace(record(moving(), missing=np.zeros(300, bool)), id="whole")
    split = split_at_gaps(problem(record(moving(), missing), whole))
    assert [e.id for e in split.experiments] == ["run", "run from 3 s", "run from 4.5 s", "whole"]
    assert [e.own_starts != () for e in split.experiments] == [False, True, True, False]
    ((said, do, treatment),) = gap_findings(split.gaps)
    assert "run has 2 gaps: 1 s, from 2 to 3 s; 0.5 s, from 4 to 4.5 s" in said
    assert "no data at all" in said
    assert 'gaps = "bridge"' in do
    assert treatment == "split"


def test_known_starts_hold_for_the_beginning_of_the_record_alone():
    split = split_at_gaps(problem(record(moving(), values={"x": 0.1, "v": 0.0, "m": 1.2})))
    first, behind = split.experiments
    assert dict(first.values) == {"x": 0.1, "v": 0.0, "m": 1.2}
    assert dict(behind.values) == {"m": 1.2}
    assert {own.variable for own in behind.own_starts} == {"x", "v"}


@pytest.mark.parametrize(
    ("change", "treatment", "why"),
    [
        ({"gaps": "bridge"}, "bridged", ""),
        (
            {"curve": Curve(("y", "v"), np.eye(2), np.array([0.0, 1.0]), (0.0, 0.0))},
            "bridged",
            "it has a curve",
        ),
    ],
)
def test_a_record_that_stays_whole(change, treatment, why):
    run = record(moving(), **change)
    split = split_at_gaps(problem(run))
    assert split.experiments == (run,)
    (gap,) = split.gaps
    assert (gap.treatment, gap.why) == (treatment, why)


def test_too_little_behind_a_gap_is_left_out():
    split = split_at_gaps(problem(record(moving(), (TIMES > 2.0) & (TIMES < 5.965))))
    assert [(e.id, e.stop) for e in split.experiments] == [("run", pytest.approx(2.0))]
    assert split.gaps[0].treatment == "left out"


def test_a_state_that_cannot_be_set_leaves_out_what_is_behind(monkeypatch):
    whole = problem(record(moving()), solver=ce.Solver("fmu"))
    hidden = replace(describe_model(whole.model), states=())
    monkeypatch.setattr("cluster_est.problem.gaps.describe_model", lambda _model: hidden)
    split = split_at_gaps(whole)
    assert [(e.id, e.stop) for e in split.experiments] == [("run", pytest.approx(2.0))]
    assert split.gaps[0].treatment == "left out"
    assert "names no states" in gap_findings(split.gaps)[0][0]


def test_what_is_held_out_shares_the_states_behind_a_gap():
    train, test = record(moving()).hold_out([(4.0, 5.0)])
    split = split_at_gaps(problem(train, test))
    ids = [e.id for e in split.experiments]
    assert ids == ["run", "run from 3 s", "run (held out) from 3 s"]
    space = make_space(split, (0, 1, 2))
    labels = {unknown.label: unknown.experiments for unknown in space.unknowns}
    assert labels["v[run from 3 s]"] == (1, 2)
    assert len(split.gaps) == 1


@pytest.fixture(scope="module")
def fitted():
    return ce.fit(problem(record(moving())))


def test_a_fit_has_the_true_values_across_a_gap(fitted):
    rows = {each.label: each for each in fitted.estimates}
    for name, true in TRUE.items():
        assert abs(rows[name].value - true) < 4.0 * rows[name].std_error
    y = position(TIMES, moving(), **TRUE, x0=0.1, v0=0.0)
    own = rows["x0[run from 3 s]"]
    assert abs(own.value - y[150]) < 4.0 * own.std_error
    assert fitted.rmse("train") == pytest.approx(1.0, abs=0.15)
    assert any("has a gap of 1 s, from 2 to 3 s" in note for note in fitted.notes)


def test_bridging_a_moving_input_does_not(fitted):
    bridged = ce.fit(problem(record(moving(), gaps="bridge")))
    assert bridged.rmse("train") > 3.0 * fitted.rmse("train")
    assert any(
        "input F may have changed there; the gap is bridged" in note for note in bridged.notes
    )


@settings(max_examples=8, deadline=None)
@given(first=st.integers(60, 140), length=st.integers(10, 60), level=st.floats(-2.0, 2.0))
def test_splitting_agrees_with_bridging_where_nothing_moves(first, length, level):
    """The rest around the gap is too short to be sure of, so that the record is split."""
    rest = slice(first - length // 4, first + length + length // 4)
    force = moving()
    force[rest] = level
    missing = np.zeros(300, bool)
    missing[first : first + length] = True
    split, bridged = (
        ce.fit(problem(record(force, missing, gaps=gaps))) for gaps in ("split", "bridge")
    )
    assert len(split.simulations) == 2
    assert len(bridged.simulations) == 1
    rows = {each.label: each for each in split.estimates}
    for name in TRUE:
        assert abs(bridged.x[name] - split.x[name]) < 4.0 * rows[name].std_error


def test_states_behind_a_gap_start_where_the_simulated_record_stands():
    split = split_at_gaps(problem(record(moving(), (TIMES > 2.0) & (TIMES < 2.3))))
    known = replace(
        split,
        parameters=tuple(
            replace(p, start=TRUE.get(p.name, 0.1 if p.name == "x0" else 0.0))
            for p in split.parameters
        ),
    )
    carried = with_carried_states(RunEnvironment(), known)
    assert carried.experiments[0] == split.experiments[0]
    starts = {own.variable: own.start for own in carried.experiments[1].own_starts}
    y = position(TIMES, moving(), **TRUE, x0=0.1, v0=0.0)
    assert starts["x"] == pytest.approx(y[115], abs=4.0 * NOISE)  # as it was measured
    assert starts["v"] == pytest.approx((y[116] - y[114]) / (2.0 * STEP), abs=0.2)  # a guess
    whole = problem(record(moving(), np.zeros(300, bool)))
    assert with_carried_states(RunEnvironment(), whole) is whole


def test_states_behind_gaps_are_no_factors_of_a_sensitivity_analysis():
    split = split_at_gaps(problem(record(moving())))
    assert [u.label for u in check_bounds(split).unknowns] == ["m", "k", "c", "x0[run]"]


def test_a_table_in_memory_says_what_becomes_of_gaps():
    columns = {"t": TIMES[~HOLE], "F": moving()[~HOLE], "y": np.sin(TIMES[~HOLE])}
    names = {"time": "t", "inputs": ["F"], "outputs": ["y"]}
    runs = [
        ce.Experiment.from_table(columns, id="run", **names, gaps=g) for g in ("split", "bridge")
    ]
    assert [len(split_at_gaps(problem(run)).experiments) for run in runs] == [2, 1]
    with pytest.raises(ce.ClusterEstError, match="gaps"):
        ce.Experiment.from_table(columns, id="run", **names, gaps="join")


@pytest.mark.parametrize(
    ("length", "said"),
    [(0.92, "0.92 s, from"), (10800.0, "10800 s (3 h), from"), (864000.0, "864000 s (10 d)")],
)
def test_a_long_gap_is_given_in_hours_or_days_too(length, said):
    assert RecordGap("run", 1.0, 1.0 + length, "", "split").interval.startswith(said)


def test_no_line_is_drawn_across_a_gap():
    times = TIMES[~HOLE]
    line = broken_line("measured", times, np.sin(times), 600)
    drawn = line.data(Scale.around(times), Scale.around(np.sin(times)))
    assert drawn.count("M") == 2
    assert broken_line("measured", TIMES, np.sin(TIMES), 600).x.tolist() == TIMES.tolist()


def test_a_model_that_computes_its_initial_states_is_refused():
    _, part = split_at_gaps(problem(record(moving()))).experiments
    names, times = ("x", "v"), np.array([3.0, 3.02])
    check_begin(part, Trajectory(names, times, np.zeros((2, 2))))
    elsewhere = Trajectory(names, times, np.array([[0.0, 0.7], [0.0, 0.7]]))
    with pytest.raises(ce.ClusterEstError, match=r"'v' was set to 0 and began at 0.7.*bridge"):
        check_begin(part, elsewhere)


def test_init_says_where_rows_are_missing(tmp_path):
    file = tmp_path / "log.csv"
    rows = [f"{t!r},{float(np.sin(t))!r}" for t in TIMES[~HOLE].tolist()]
    file.write_text("\n".join(["time,y", *rows]))
    (said,) = read_columns(file).notes
    assert said.startswith("no rows between 2 and 3 of 'time'; set gaps")


@pytest.mark.parametrize(
    ("empty", "inputs", "start"), [(20, ["F"], 0.4), (3, ["F"], 0.0), (20, [], 0.0)]
)
def test_a_record_begins_behind_rows_without_any_cell(empty, inputs, start):
    """Without inputs it may well begin before its first value."""
    columns = {"t": TIMES, "F": moving(), "y": np.sin(TIMES)}
    for name in "Fy":
        columns[name] = np.where(np.arange(300) < empty, np.nan, columns[name])
    run = ce.Experiment.from_table(columns, id="run", time="t", inputs=inputs, outputs=["y"])
    assert run.start == pytest.approx(start)
    given = ce.Experiment.from_table(
        columns, id="run", time="t", inputs=inputs, outputs=["y"], start=-1.0
    )
    assert given.start == -1.0


def test_gaps_of_many_records_are_counted_in_the_end():
    gaps = [RecordGap(f"run{i}", 1.0, 2.0, "", "split", ("F",)) for i in range(50)]
    found = gap_findings(gaps)
    assert "run0 has a gap of 1 s, from 1 to 2 s" in found[0][0]
    assert found[-1][0] == "38 more gaps in 38 experiments"
