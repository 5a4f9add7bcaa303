"""What a search among a few forms accepts, refuses and says, on springs that take a second each.

The data are what the plain model makes of another force than the one that is declared, so that no
effect is involved in them, or SciPy's.
"""

from dataclasses import replace
from itertools import repeat

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.signal import lfilter
from support.problems.driven_springs import (
    LARGEST,
    MASS,
    RESONANCE,
    dead,
    driven_by,
    pushed_by_waves,
)
from support.problems.measured_springs import measured_springs
from support.truth.springs_with_effects import M, plain, pushed, solve
from support.truth.systems_with_missing_effects import missing_effect_problem

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.problem.tables.sources import TableSource


def settings(site: str, *forms: str, **more) -> ce.LoopSettings:
    return ce.LoopSettings(sites=(site,), forms=forms, draws=200, pairs=False, **more)


WAVES = settings("der(v)", "sine", "coulomb", max_effects=1)


def test_a_wave_that_all_experiments_agree_on_is_found_with_its_period():
    """Its acceleration is 1 m/s2; the frequency is no peak of the spectrum's grid."""
    found = ce.close_loop(pushed_by_waves(9.3, (1.0, 1.0)), settings=WAVES)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.form, effect.words) == ("sine", "a sinusoid in time")
    assert effect.period == pytest.approx(2.0 * np.pi / 9.3, rel=0.01)
    strengths = {c.label.rpartition(".")[2]: c.value for c in effect.coefficients}
    assert np.hypot(strengths["a"], strengths["b"]) == pytest.approx(1.0, rel=0.02)
    assert any("and the same phase in all experiments" in said for said in effect.evidence)
    assert not any("too narrow" in note for note in found.notes)


@pytest.mark.parametrize(
    ("frequency", "ways"),
    [
        pytest.param(RESONANCE, (1.0, 1.0), id="a resonance of the model", marks=pytest.mark.slow),
        pytest.param(2.0, (1.0, 1.0), id="less than three periods in a record"),
        pytest.param(9.3, (1.0, 0.1), id="another one in each experiment"),
    ],
)
def test_a_wave_that_cannot_be_believed_is_not_added(frequency, ways):
    found = ce.close_loop(pushed_by_waves(frequency, ways), settings=WAVES)
    assert found.verdict == Verdict.UNEXPLAINED
    assert found.effects == ()
    assert "sinusoids or drifts in time" in found.message


def test_a_spring_and_a_damper_in_series_are_found():
    """Their force is a state that the model lacks: 5 N/m for each kg, 0.4 s."""

    def slope(t, x, force):
        v, dv = plain(t, x, force)
        return [v, dv - x[2], 5.0 * v - x[2] / 0.4]

    problem = missing_effect_problem("mass_spring_damper", signals=())
    runs, generator = [], np.random.default_rng(2)
    for run in problem.experiments:
        (given,), (shown,) = run.inputs, run.outputs
        y = solve(slope, (0.1, 0.0, 0.0), given.times, given.values)[:, 0]
        seen = replace(shown, values=y + 0.002 * generator.standard_normal(len(y)), sigma=0.002)
        runs.append(replace(run, outputs=(seen,)))
    forms = settings("der(v)", "store", "coulomb", "linear", max_effects=1)
    found = ce.close_loop(replace(problem, experiments=tuple(runs)), settings=forms)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.form, effect.effect.variables) == ("store", ("x",))
    assert effect.words == "an exchange with a hidden store that lags behind x"
    values = {c.label.rpartition(".")[2]: c.value for c in effect.coefficients}
    assert values == pytest.approx({"k": 5.0, "tau": 0.4}, rel=0.1)


def retraced(force: np.ndarray, x0: float) -> np.ndarray:
    """The state of a hysteresis, which depends on the way of the force alone."""
    states = [0.0]
    for moved in (np.diff(force) / x0).tolist():
        states.append(np.sign(moved) + (states[-1] - np.sign(moved)) * np.exp(-abs(moved)))
    return np.array(states)


def test_a_hysteresis_of_an_actuator_is_found():
    problem = driven_by(*2 * [lambda t, f: f - 0.6 * retraced(f, 2.0)])
    forms = settings("input F", "hysteresis", "backlash", "lag", max_effects=1)
    found = ce.close_loop(problem, settings=forms)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.form, effect.words) == ("hysteresis", "a hysteresis")
    values = {c.label.rpartition(".")[2]: c.value for c in effect.coefficients}
    assert (values["k"], values["x0"]) == pytest.approx((-0.6, 2.0), rel=0.1)


def test_play_before_a_sensor_is_found():
    """The position is seen behind a play of 8 mm to each side."""
    problem = driven_by(*2 * [lambda t, f: f])
    runs, generator = [], np.random.default_rng(4)
    for run in problem.experiments:
        (given,), (shown,) = run.inputs, run.outputs
        moved = solve(plain, (0.1, 0.0), given.times, given.values)[:, 0]
        y = [moved[0]]
        for x in moved[1:].tolist():
            y.append(min(max(y[-1], x - 0.008), x + 0.008))
        seen = np.array(y) + 0.002 * generator.standard_normal(len(y))
        runs.append(replace(run, outputs=(replace(shown, values=seen),)))
    forms = settings("output y", "backlash", "lag", "dead_zone", "gain", max_effects=1)
    found = ce.close_loop(replace(problem, experiments=tuple(runs)), settings=forms)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.form, effect.words) == ("backlash", "backlash")
    assert effect.coefficients[0].value == pytest.approx(0.008, rel=0.1)


def gusts(seed: int, size: float) -> np.ndarray:
    """A smooth random force."""
    drawn = np.random.default_rng(seed).standard_normal(1101)
    slow = lfilter([1.0], [1.0, -1.94, 0.944], drawn)[500:]
    return np.asarray(size * slow / slow.std())


def test_a_drift_that_would_leave_more_than_noise_is_not_added():
    """A force that grows, in gusts: of what is left it is said how large it is, and where."""
    problem = driven_by(*(lambda t, f, s=s: f + 2.0 * t + gusts(s, 0.5) for s in (1, 2)))
    found = ce.close_loop(problem, settings=settings("der(v)", "drift", "coulomb"))
    assert found.verdict == Verdict.UNEXPLAINED
    assert found.effects == ()
    assert "drift at der(v) would leave more than noise and was not added" in found.message
    assert "a function of time can imitate any slow disturbance" in found.message
    assert "The cause may also be an unmeasured disturbance" in found.message
    assert any("so they are too narrow" in note for note in found.notes)
    assert any("largest in" in note or "spread evenly" in note for note in found.notes)
    assert found.rejected == ()
    (left,) = found.unexplained
    assert left.output == "y"
    assert left.over_noise > 2.0


def test_with_functions_of_time_alone_there_is_nothing_else_to_find():
    problem = driven_by(*(lambda t, f, s=s: f + 2.0 * t + gusts(s, 0.5) for s in (1, 2)))
    found = ce.close_loop(problem, settings=settings("der(v)", "drift"))
    assert found.verdict == Verdict.UNEXPLAINED
    assert "apart from functions of time, no effect could be tried; drift" in found.message
    assert found.rejected == ()


@pytest.mark.slow
def test_what_was_found_beside_such_a_drift_is_judged_without_it():
    """A small gap is closed by a dead zone at the force, most of the rest would be by a drift."""
    problem = driven_by(
        *(lambda t, f, s=s: dead(f, 0.3 * LARGEST) + 0.3 * t + gusts(s, 0.1) for s in (1, 2))
    )
    few = ce.LoopSettings(sites=("der(v)", "input F"), forms=("dead_zone", "drift"), draws=200)
    found = ce.close_loop(problem, settings=few)
    assert found.verdict == Verdict.UNEXPLAINED
    assert "drift at der(v) would leave more than noise and was not added" in found.message
    assert [(effect.form, effect.site) for effect in found.rejected] == [("dead_zone", "input F")]
    for each in found.rejected:
        assert np.isnan(each.claim.probability)
        assert each.claim.sentence in found.message


def test_a_drift_that_leaves_noise_is_found():
    problem = driven_by(*repeat(lambda t, f: f + 0.5 * MASS * t, 2))
    found = ce.close_loop(problem, settings=settings("der(v)", "drift", "coulomb", "sine"))
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.form, effect.coefficients[0].value) == ("drift", pytest.approx(0.5, rel=0.03))


@pytest.mark.slow
def test_a_column_that_varies_with_what_nothing_explains_is_named(tmp_path):
    """A force that was logged, 3 times as large, and that the config does not use."""
    problem = driven_by(*(lambda t, f, s=s: f + gusts(s, 1.0) for s in (3, 4)))
    sources = []
    for run, seed in zip(problem.experiments, (3, 4), strict=True):
        (output,) = run.outputs
        columns = {"t": output.times, "y": output.values, "gust_N": 3.0 * gusts(seed, 1.0)}
        path = tmp_path / f"{run.id}.csv"
        pacsv.write_csv(pa.table(columns), path)
        sources.append(TableSource(run.id, path, "t", None, None, ("t", "y")))
    problem = replace(problem, tables=tuple(sources))
    found = ce.close_loop(problem, settings=settings("der(v)", "coulomb", "cubic"))
    assert found.verdict == Verdict.UNEXPLAINED
    assert "The unused column 'gust_N' explains" in found.message
    assert [len(each.columns) for each in found.unexplained] == [1]


def test_a_dead_zone_is_found_whose_grid_is_far_from_it():
    """In three tenths of the largest force there is no gradient where it is not reached."""
    width = 0.3 * LARGEST
    problem = driven_by(*repeat(lambda t, f: dead(f, width), 2))
    found = ce.close_loop(problem, settings=settings("input F", "dead_zone"))
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert effect.coefficients[0].value == pytest.approx(width, rel=0.01)


@pytest.mark.slow
def test_a_limit_is_drawn_over_what_was_measured_before_it():
    limit = 0.5 * LARGEST
    problem = driven_by(*repeat(lambda t, f: np.clip(f, -limit, limit), 2))
    found = ce.close_loop(problem, settings=settings("input F", "saturation", "gain"))
    assert found.verdict == Verdict.FOUND
    (curve,) = found.curves
    assert (curve.variable, curve.unit) == ("F", "N")
    assert max(-curve.x[0], curve.x[-1]) == pytest.approx(LARGEST)
    assert np.abs(curve.y).max() == pytest.approx(limit, rel=0.01)


@pytest.mark.slow
def test_a_switch_that_is_wide_is_one_friction_with_its_width():
    """It is not patched, and written to the config with an unknown width."""
    problem = measured_springs(
        pushed(lambda t, x, f: -2.0 * np.tanh(x[1] / 0.02)),
        ce.Parameter("m", 1.1 * M, (0.1, 10.0)),
        swing=12.0,
        noise=1e-4,
        random=np.random.default_rng(3),
        roles=("train", "train", "test"),
    )
    sites = ("der(v)", "input F", "output y")
    result = ce.close_loop(problem, settings=ce.LoopSettings(sites=sites))
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    assert (effect.site, effect.form) == ("der(v)", "coulomb")
    values = {e.parameter: e.value for e in effect.coefficients}
    assert values["coulomb_v.k"] == pytest.approx(2.0, rel=0.01)
    assert values["coulomb_v.width"] == pytest.approx(0.02, rel=0.1)
    assert result.rms("test", "after") < 1.1
    block = result.facts()["effects"][0]["config"]
    assert "width" in block
    assert "fixed" not in block
