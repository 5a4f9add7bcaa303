"""Maps as parameters: the force of a spring as a table, smooth and monotone where that is known."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.integrate import solve_ivp

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.config.maps import with_maps
from cluster_est.config.reader import parse_config
from cluster_est.errors import ConfigError
from cluster_est.run_folder.reading import read_run_table
from cluster_est.toml import to_toml

POINTS = np.linspace(-1.0, 1.0, 9)
TRUE = 6.0 * np.tanh(1.5 * POINTS) + POINTS**3
TIMES = 0.02 * np.arange(501)
NOISE = 0.004


def driving(strength):
    return strength * np.sin(0.8 * TIMES) * np.sin(2.1 * TIMES + 0.4)


def moved(force):
    """The displacement, by a solver and a table that are not the project's."""

    def rates(t, state):
        spring = np.interp(state[0], POINTS, TRUE)
        return [state[1], np.interp(t, TIMES, force) - spring - 0.5 * state[1]]

    solved = solve_ivp(rates, (0.0, TIMES[-1]), [0.0, 0.0], t_eval=TIMES, rtol=1e-8, max_step=0.02)
    return solved.y[0]


def config(folder, own_fmu, strength=2.5, **keys):
    force = driving(strength)
    noise = NOISE * np.random.default_rng(4).standard_normal(len(TIMES))
    table = pa.table({"time": TIMES, "F": force, "x": moved(force) + noise})
    pacsv.write_csv(table, folder / "run.csv")
    section = {
        "variables": [f"f{i}" for i in range(1, 10)],
        "points": POINTS.tolist(),
        "start": (5.0 * POINTS).tolist(),
        "bounds": [-20.0, 20.0],
    }
    return {
        "model": {"fmu": str(own_fmu("spring_table", 2))},
        "maps": {"spring": section | keys},
        "experiments": [
            {
                "id": "run",
                "data": str(folder / "run.csv"),
                "time": "time",
                "inputs": {"u": "F"},
                "outputs": {"y": "x"},
                "sigma": {"y": NOISE},
            }
        ],
    }


def fitted(folder, own_fmu, **how):
    (folder / "config.toml").write_text(to_toml(config(folder, own_fmu, **how)), encoding="utf-8")
    problem = ce.read_problem(folder / "config.toml")
    result = ce.fit(problem)
    assert result.success
    rows = {row["parameter"]: row["value"] for row in result.parameters.to_pylist()}
    return np.array([rows[f"spring_{i}"] for i in range(1, 10)]), result


def test_every_value_of_a_map_is_a_parameter(tmp_path, own_fmu):
    values, result = fitted(tmp_path, own_fmu)
    errors = {e.parameter: e.std_error for e in result.estimates}
    visited = np.abs(POINTS) <= 0.5
    own = np.array([errors[f"spring_{i}"] for i in range(1, 10)])[visited]
    assert (np.abs(values - TRUE)[visited] < 4.0 * own).all()


def test_smoothness_fills_what_the_data_did_not_visit(tmp_path, own_fmu):
    """Where a small motion never comes, a table of free values stays where it began."""
    free, _ = fitted(tmp_path, own_fmu, strength=1.0)
    smooth, result = fitted(tmp_path, own_fmu, strength=1.0, slope_change=10.0)
    outside = np.abs(POINTS) == 0.75
    assert np.abs(smooth - TRUE)[outside].max() < np.abs(free - TRUE)[outside].max()
    errors = {e.parameter: e.std_error for e in result.estimates}
    own = np.array([errors[f"spring_{i}"] for i in range(1, 10)])
    assert np.isfinite(own[[0, 4]]).all()
    assert own[0] > own[4]  # what nobody has measured is known the least


def test_a_smooth_map_fits_the_data_as_well_as_a_free_one(tmp_path, own_fmu):
    _, free = fitted(tmp_path, own_fmu)
    _, smooth = fitted(tmp_path, own_fmu, slope_change=10.0)
    priors = 7  # of which each costs about 1
    assert smooth.cost < free.cost + 3.0 * priors


def test_a_monotone_map_increases(tmp_path, own_fmu):
    values, _ = fitted(tmp_path, own_fmu, strength=1.0, monotone="increasing")
    assert (np.diff(values) >= -1e-6).all()


def test_more_points_make_a_map_no_rougher():
    """The prior's scatter of the value at the end does not depend on how many points there are."""

    def scatter(count):
        points = np.linspace(0.0, 2.0, count)
        section = {
            "variables": [f"p{i}" for i in range(count)],
            "points": points.tolist(),
            "start": 0.0,
            "bounds": [-9.0, 9.0],
            "slope_change": 0.5,
        }
        made = with_maps(parse_config(minimal(section), "c.toml"))
        sds = [made.parameters[f"map_bend_{i}"].prior["sd"] for i in range(2, count)]
        return np.sqrt(sum((sd * (2.0 - x)) ** 2 for sd, x in zip(sds, points[1:-1], strict=True)))

    expected = 0.5 * np.sqrt(2.0**3 / 3.0)  # of an integrated Wiener process
    assert scatter(41) == pytest.approx(expected, rel=0.05)
    assert scatter(11) == pytest.approx(expected, rel=0.2)


def minimal(section):
    run = {"id": "e", "data": "e.csv", "time": "t", "outputs": {"y": "y"}}
    return {"model": {"fmu": "m.fmu"}, "maps": {"map": section}, "experiments": [run]}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"points": [0.0, 0.0, 1.0]}, "maps.map.points: must increase but do not"),
        ({"variables": ["a", "b"]}, "maps.map.variables: must be as many as the points, 3"),
        ({"start": [1.0]}, "maps.map.start: must be a number, or one for each of the 3 points"),
        ({"slope_change": 1.0}, "maps.map.bounds: must be finite where slope_change says"),
        ({"bounds": [2.0, 1.0]}, "maps.map.bounds: must be [lower, upper]"),
        ({"slope_change": 0.0}, "maps.map.slope_change: must be greater than 0"),
        ({"start": 5.0, "bounds": [0.0, 2.0]}, "maps.map.start: must lie within the bounds"),
        ({"monotone": "up"}, "maps.map.monotone: must be '', 'increasing' or 'decreasing'"),
    ],
)
def test_a_map_that_contradicts_itself_is_refused_in_a_sentence(change, sentence):
    section = {"variables": ["a", "b", "c"], "points": [0.0, 0.5, 1.0], "start": 1.0} | change
    with pytest.raises(ConfigError) as raised:
        with_maps(parse_config(minimal(section), "c.toml"))
    assert sentence in str(raised.value)


def test_a_name_must_make_names_of_values():
    section = {"variables": ["a", "b"], "points": [0.0, 1.0], "start": 1.0}
    tree = minimal(section) | {"maps": {"my-map": section}}
    with pytest.raises(ConfigError, match=r"maps\.my-map: must have a name of letters"):
        with_maps(parse_config(tree, "c.toml"))


def test_a_name_that_is_taken_is_refused():
    section = {"variables": ["a", "b"], "points": [0.0, 1.0], "start": 1.0}
    tree = minimal(section) | {"parameters": {"map_2": {"start": 1.0}}}
    with pytest.raises(ConfigError, match="its value map_2 must have a name of its own"):
        with_maps(parse_config(tree, "c.toml"))


@pytest.mark.parametrize("smooth", [{}, {"slope_change": 10.0, "monotone": "increasing"}])
def test_what_is_exported_reads_back_as_starts(tmp_path, own_fmu, smooth):
    """Of a run with a map, by the FMU's names; a start in the config is not needed then."""
    tree = config(tmp_path, own_fmu, **smooth)
    path, run = tmp_path / "config.toml", tmp_path / "run"
    path.write_text(to_toml(tree), encoding="utf-8")
    assert main(["fit", str(path), "--out", str(run), "--no-report"]) == 0
    rows = {r["parameter"]: r["value"] for r in read_run_table(run / "parameters.parquet")}
    found = [rows[f"spring_{i}"] for i in range(1, 10)]
    del tree["maps"]["spring"]["start"]
    for name in ("found.csv", "found.ssv"):
        assert main(["export", str(run), f"--{name[-3:]}", str(tmp_path / name)]) == 0
        path.write_text(to_toml({"value_files": [name]} | tree), encoding="utf-8")
        resolved = ce.read_config(path)
        assert resolved.maps["spring"].start == pytest.approx(found, rel=1e-12)
        assert not resolved.values
        before = ce.simulate(ce.read_problem(path))[0].outcome.trajectory.at("y", TIMES)
        assert before == pytest.approx(moved_by(found), abs=1e-5)


def moved_by(values):
    """The displacement with these values in the table of the spring."""

    def rates(t, state):
        spring = np.interp(state[0], POINTS, values)
        return [state[1], np.interp(t, TIMES, driving(2.5)) - spring - 0.5 * state[1]]

    solved = solve_ivp(
        rates, (0.0, TIMES[-1]), [0.0, 0.0], t_eval=TIMES, rtol=1e-9, atol=1e-10, max_step=0.02
    )
    return solved.y[0]


SECTION = {"variables": ["a", "b", "c"], "points": [0.0, 0.5, 1.0], "bounds": [-9.0, 9.0]}


def read_with_values(folder, section, values):
    (folder / "found.csv").write_text(f"name,value\n{values}", encoding="utf-8")
    tree = {"value_files": ["found.csv"]} | minimal(section)
    (folder / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    return ce.read_config(folder / "config.toml")


def test_values_of_a_file_take_the_place_of_their_starts_alone(tmp_path):
    read = read_with_values(tmp_path, SECTION | {"start": 1.0}, "b,3\nmass,2\n")
    assert read.maps["map"].start == [1.0, 3.0, 1.0]
    assert read.values == {"mass": 2}


def test_a_fixed_map_has_known_values(tmp_path):
    section = SECTION | {"fixed": True, "slope_change": 1.0, "monotone": "increasing"}
    made = with_maps(read_with_values(tmp_path, section, "b,3\na,2\nc,2.5\n"))
    assert {k: (p.start, p.fixed, p.variable) for k, p in made.parameters.items()} == {
        "map_1": (2.0, True, "a"),
        "map_2": (3.0, True, "b"),
        "map_3": (2.5, True, "c"),
    }
    assert not made.constraints


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ("b,3\n", "maps.map.start: must be there where the files of values have not all of its"),
        ("a,1\nb,high\nc,1\n", "found.csv: b must be a number, because it is estimated, but is"),
        ("a,1\nb,99\nc,1\n", "maps.map.start: must lie within the bounds [-9.0, 9.0] but has 99"),
    ],
)
def test_values_that_do_not_fit_a_map_are_refused_in_a_sentence(tmp_path, values, sentence):
    with pytest.raises(ConfigError) as raised:
        with_maps(read_with_values(tmp_path, SECTION, values))
    assert sentence in str(raised.value)


def test_a_run_with_a_map_is_shown_with_its_values(tmp_path, own_fmu, capsys):
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config(tmp_path, own_fmu, slope_change=10.0)), encoding="utf-8")
    assert main(["fit", str(path), "--out", str(tmp_path / "run"), "--no-report"]) == 0
    printed = capsys.readouterr().out
    assert "spring_9" in printed
    assert "spring_bend_2" in printed
