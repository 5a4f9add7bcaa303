"""Maps as parameters: the force of a spring as a table, smooth and monotone where that is known."""

from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.integrate import solve_ivp
from support.described import real, write_fmu

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.run_folder.run_files import read_run_table
from cluster_est.toml import to_toml

POINTS = np.linspace(-1.0, 1.0, 9)
TRUE = 6.0 * np.tanh(1.5 * POINTS) + POINTS**3
TIMES = 0.02 * np.arange(501)
NOISE = 0.004
NAMES = [f"spring_{i}" for i in range(1, 10)]
SMOOTH = {"slope_change": 10.0}


def driving(strength):
    return strength * np.sin(0.8 * TIMES) * np.sin(2.1 * TIMES + 0.4)


@cache
def moved(strength, values=tuple(TRUE)):
    """The displacement, by a solver and a table that are not the project's."""

    def rates(t, state):
        spring = np.interp(state[0], POINTS, values)
        return [state[1], np.interp(t, TIMES, driving(strength)) - spring - 0.5 * state[1]]

    how = {"t_eval": TIMES, "rtol": 1e-9, "atol": 1e-10, "max_step": 0.02}
    return solve_ivp(rates, (0.0, TIMES[-1]), [0.0, 0.0], **how).y[0]


def config(folder, own_fmu, strength=2.5, **keys):
    noise = NOISE * np.random.default_rng(4).standard_normal(len(TIMES))
    columns = {"time": TIMES, "F": driving(strength), "x": moved(strength) + noise}
    pacsv.write_csv(pa.table(columns), folder / "run.csv")
    section = {"variables": [f"f{i}" for i in range(1, 10)], "points": POINTS.tolist()}
    section |= {"start": (4.5 * POINTS).tolist(), "bounds": [-20.0, 20.0]}
    run = {"id": "run", "data": str(folder / "run.csv"), "time": "time", "sigma": {"y": NOISE}}
    return {
        "model": {"fmu": str(own_fmu("spring_table", 2))},
        "maps": {"spring": section | keys},
        "experiments": [run | {"inputs": {"u": "F"}, "outputs": {"y": "x"}}],
    }


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, own_fmu):
    """The values of a map that were found, their standard errors and the result; once each."""

    @cache
    def call(strength=2.5, smooth=False, monotone=""):
        folder = tmp_path_factory.mktemp("map")
        keys = {"monotone": monotone, **(SMOOTH if smooth else {})}
        tree = config(folder, own_fmu, strength, **keys)
        (folder / "config.toml").write_text(to_toml(tree), encoding="utf-8")
        result = ce.fit(ce.read_problem(folder / "config.toml"))
        assert result.success
        rows = {row["parameter"]: row["value"] for row in result.table("parameters").to_pylist()}
        errors = {e.parameter: e.std_error for e in result.estimates}
        own = np.array([errors.get(name, np.nan) for name in NAMES], float)
        return np.array([rows[name] for name in NAMES]), own, result

    return call


def test_every_value_of_a_map_is_a_parameter_and_a_smooth_one_fits_as_well(fitted):
    values, errors, result = fitted()
    visited = np.abs(POINTS) <= 0.5
    assert (np.abs(values - TRUE)[visited] < 4.0 * errors[visited]).all()
    priors = 7  # of which each costs about 1
    assert fitted(smooth=True)[2].cost < result.cost + 3.0 * priors


@pytest.mark.slow
def test_smoothness_fills_what_the_data_did_not_visit(fitted):
    """Where a small motion never comes, a table of free values stays where it began."""
    free, _, _ = fitted(1.0)
    smooth, errors, _ = fitted(1.0, smooth=True)
    outside = np.abs(POINTS) == 0.75
    assert np.abs(smooth - TRUE)[outside].max() < np.abs(free - TRUE)[outside].max()
    assert np.isfinite(errors[[0, 4]]).all()
    assert errors[0] > errors[4]  # what nobody has measured is known the least


def test_a_monotone_map_increases(fitted):
    values, _, _ = fitted(1.0, monotone="increasing")
    assert (np.diff(values) >= -1e-6).all()


@pytest.mark.parametrize(
    "smooth", [pytest.param({}, marks=pytest.mark.slow), SMOOTH | {"monotone": "increasing"}]
)
def test_what_a_run_shows_and_exports_reads_back_as_starts(tmp_path, own_fmu, capsys, smooth):
    """Of a run with a map, by the FMU's names; a start in the config is not needed then."""
    tree = config(tmp_path, own_fmu, **smooth)
    path, run = tmp_path / "config.toml", tmp_path / "run"
    path.write_text(to_toml(tree), encoding="utf-8")
    assert main(["fit", str(path), "--out", str(run), "--no-report"]) == 0
    printed = capsys.readouterr().out
    assert "spring_9" in printed
    assert ("spring_bend_2" in printed) == bool(smooth)
    rows = {r["parameter"]: r["value"] for r in read_run_table(run / "parameters.parquet")}
    found = [rows[name] for name in NAMES]
    del tree["maps"]["spring"]["start"]
    for name in ("found.csv", "found.ssv"):
        assert main(["export", str(run), f"--{name[-3:]}", str(tmp_path / name)]) == 0
        path.write_text(to_toml({"value_files": [name]} | tree), encoding="utf-8")
        resolved = ce.read_config(path)
        assert resolved.maps["spring"].start == pytest.approx(found, rel=1e-12)
        assert not resolved.values
    (simulation,) = ce.simulate(ce.read_problem(path)).values()
    before = simulation.outcome.trajectory.at("y", TIMES)
    assert before == pytest.approx(moved(2.5, tuple(found)), abs=1e-5)


SECTION = {"variables": ["a", "b", "c"], "points": [0.0, 0.5, 1.0], "bounds": [-9.0, 9.0]}


@pytest.fixture
def read(tmp_path):
    """The problem of a map, of parameters of an FMU that is only described."""
    names = ["a", "b", "c", "mass", *(f"p{i}" for i in range(41))]
    parameters = [real(name, "parameter", start=1) for name in names]
    fmu = write_fmu(tmp_path, *parameters, real("y", "output"))
    (tmp_path / "e.csv").write_text("t,y\n0,0\n1,0\n", encoding="utf-8")

    def call(section, values=None, name="map", **more):
        run = {"id": "e", "data": "e.csv", "time": "t", "outputs": {"y": "y"}}
        tree = {"model": {"fmu": fmu.name}, "maps": {name: section}, "experiments": [run], **more}
        if values is not None:
            (tmp_path / "found.csv").write_text(f"name,value\n{values}", encoding="utf-8")
            tree = {"value_files": ["found.csv"]} | tree
        (tmp_path / "config.toml").write_text(to_toml(tree), encoding="utf-8")
        return ce.read_problem(tmp_path / "config.toml")

    return call


@pytest.mark.parametrize(("count", "rel"), [(41, 0.05), (11, 0.2)])
def test_more_points_make_a_map_no_rougher(read, count, rel):
    """The prior's scatter of the value at the end does not depend on how many points there are."""
    points = np.linspace(0.0, 2.0, count)
    section = {"variables": [f"p{i}" for i in range(count)], "points": points.tolist()}
    section |= {"start": 0.0, "bounds": [-9.0, 9.0], "slope_change": 0.5}
    priors = {p.name: p.prior for p in read(section).parameters}
    sds = [priors[f"map_bend_{i}"].sd for i in range(2, count)]
    scatter = np.sqrt(sum((sd * (2.0 - x)) ** 2 for sd, x in zip(sds, points[1:-1], strict=True)))
    expected = 0.5 * np.sqrt(2.0**3 / 3.0)  # of an integrated Wiener process
    assert scatter == pytest.approx(expected, rel=rel)


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"points": [0.0, 0.0, 1.0]}, "maps.map.points: must increase"),
        (
            {"variables": ["a", "b"]},
            "maps.map.variables: must have a name for each of the 3 points, but has 2",
        ),
        ({"start": [1.0]}, "maps.map.start: .*one for each of the 3 points"),
        ({"slope_change": 1.0}, "maps.map.bounds: .*finite with slope_change"),
        ({"bounds": [2.0, 1.0]}, r"maps.map.bounds: .*\[lower, upper\]"),
        ({"slope_change": 0.0}, "maps.map.slope_change: .*greater than 0"),
        ({"start": 5.0, "bounds": [0.0, 2.0]}, "maps.map.start: .*within the bounds"),
        ({"monotone": "up"}, "maps.map.monotone: .*'', 'increasing' or 'decreasing'"),
    ],
)
def test_a_map_that_contradicts_itself_is_refused(read, change, pattern):
    section = {"variables": ["a", "b", "c"], "points": [0.0, 0.5, 1.0], "start": 1.0} | change
    with pytest.raises(ce.ClusterEstError, match=pattern):
        read(section)


TAKEN, STARTED = {"map_2": {"start": 1.0}}, SECTION | {"start": 1.0}


@pytest.mark.parametrize(
    ("section", "given", "pattern"),
    [
        (STARTED, {"name": "my-map"}, r"maps\.my-map: the name must consist of letters"),
        (STARTED, {"parameters": TAKEN}, "its value map_2 must have a unique name"),
        (STARTED, {"values": "a,1\nb,high\nc,1\n"}, "found.csv: b is estimated, .*a number"),
        (STARTED, {"values": "a,1\nb,99\nc,1\n"}, r"maps.map.start: .*bounds \[-9.0, 9.0\].*99"),
        (SECTION, {"values": "b,3\n"}, r"maps.map.start is missing, and no file of values"),
    ],
)
def test_names_and_values_of_files_that_do_not_fit(read, section, given, pattern):
    with pytest.raises(ce.ClusterEstError, match=pattern):
        read(section, **given)


def test_values_of_a_file_take_the_place_of_their_starts_alone(read):
    made = read(STARTED, "b,3\nmass,2\n")
    assert [p.start for p in made.parameters] == [1.0, 3.0, 1.0]
    assert made.experiments[0].values == (("mass", 2),)


def test_a_fixed_map_has_known_values(read):
    fixed = {"fixed": True, "slope_change": 1.0, "monotone": "increasing"}
    free = {"mass": {"start": 1.0}}
    made = read(SECTION | fixed, "b,3\na,2\nc,2.5\n", parameters=free)
    assert {p.name: (p.start, p.fixed, p.target) for p in made.parameters} == {
        "mass": (1.0, False, "mass"),
        "map_1": (2.0, True, "a"),
        "map_2": (3.0, True, "b"),
        "map_3": (2.5, True, "c"),
    }
    assert not made.constraints
