import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import cluster_est as ce
from cluster_est.errors import DataError
from cluster_est.problem.tables.units import conversion, is_known, same_unit

COLUMNS = {
    "t": [0.0, 0.5, 1.0, 1.5],
    "force": [1, 2, 3, 4],
    "position": [0.0, np.nan, 0.2, 0.3],
    "words": ["1.5", "2", "x", ""],
    "when": pd.to_timedelta([0, 1, 2, 3], unit="s"),
}
GIVEN = {"id": "a", "time": "t", "inputs": {"F": "force"}, "outputs": {"y": "position"}}


class FromAnotherLibrary:
    """A table that offers nothing but the Arrow stream, as those of polars do."""

    def __init__(self, table):
        self.__arrow_c_stream__ = table.__arrow_c_stream__


TABLES = {
    "dict": lambda: COLUMNS,
    "pandas": lambda: pd.DataFrame(COLUMNS),
    "pandas with the time as index": lambda: pd.DataFrame(COLUMNS).set_index("t"),
    "pyarrow": lambda: pa.Table.from_pandas(pd.DataFrame(COLUMNS)),
    "stream": lambda: FromAnotherLibrary(pa.Table.from_pandas(pd.DataFrame(COLUMNS))),
}


def written(folder):
    path = folder / "run.csv"
    pd.DataFrame(COLUMNS).drop(columns="when").to_csv(path, index=False)
    return path


@pytest.mark.parametrize("name", TABLES)
def test_every_kind_of_table_makes_what_a_file_makes(name, tmp_path):
    expected = ce.Experiment.from_table(written(tmp_path), **GIVEN)
    assert ce.Experiment.from_table(ce.read_table(written(tmp_path)), **GIVEN).key == expected.key
    found = ce.Experiment.from_table(TABLES[name](), **GIVEN)
    assert found.key == expected.key
    assert found.stop == 1.5
    assert found.outputs[0].times.tolist() == [0.0, 1.0, 1.5]  # an empty cell is not measured
    assert found.inputs[0].values.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_its_options_are_those_of_a_config():
    found = ce.Experiment.from_table(
        COLUMNS, id="a", sample_time=0.1, rows=(1, 4), start=0.05, role="test",
        inputs={"F": {"column": "force", "interpolation": "hold"}},
        outputs=["position"], sigma={"position": 0.1}, relative_sigma=0.05,
        columns={"force": {"factor": 10.0, "offset": 1.0, "demean": True}},
        signals={"sun": "force"}, values={"m": 2.0}, groups={"size": "big"},
    )  # fmt: skip
    assert found.inputs[0].interpolation == "hold"
    assert found.inputs[0].values.tolist() == [-9.0, 1.0, 11.0]
    assert (found.outputs[0].sigma, found.outputs[0].relative_sigma) == (0.1, 0.05)
    assert found.outputs[0].values.tolist() == [0.2, 0.3]
    assert found.start == 0.05
    assert found.signals[0].variable == "sun"
    assert found.role == "test"
    assert (found.values, found.groups) == ((("m", 2.0),), (("size", "big"),))


def test_an_output_says_how_it_was_observed():
    given = {"column": "position", "free_scale": True, "free_offset": True}
    found = ce.Experiment.from_table(COLUMNS, **GIVEN | {"outputs": {"y": given}})
    (output,) = found.outputs
    assert (output.free_scale, output.free_offset, output.ordinal) == (True, True, False)
    assert output.values.tolist() == [0.0, 0.2, 0.3]
    limited = {"column": "position", "detection_limit": 0.25}
    found = ce.Experiment.from_table(COLUMNS, **GIVEN | {"outputs": {"y": limited}})
    assert found.outputs[0].values.tolist() == [0.25, 0.25, 0.3]


@pytest.mark.parametrize("words", [["low", "middle", "high"], ("low", "middle", "high")])
def test_words_are_places_among_the_grades(words):
    graded = {"t": [0.0, 1.0, 2.0], "state": ["middle", "high", "low"]}
    given = {"column": "state", "ordinal": words}
    found = ce.Experiment.from_table(graded, id="a", time="t", outputs={"y": given})
    assert found.outputs[0].ordinal is True
    assert found.outputs[0].values.tolist() == [2.0, 3.0, 1.0]


def of_y(**more):
    """The output's column and more."""
    return {"outputs": {"y": {"column": "position", **more}}}


REFUSED = [
    ({"outputs": {}}, "experiment 'a'.outputs is missing; add it"),
    ({"outputs": ["position"] * 2}, "outputs 'position': .*appears twice"),
    ({"outputs": {3: "position"}}, "outputs: a variable: .*text.*3"),
    ({"outputs": "y"}, "outputs: .*a list of text.*a single one; put it in brackets"),
    ({"inputs": {"F": {"column": "force", "how": 1}}}, "inputs.F: unknown key how"),
    ({"inputs": {"F": 3}}, "inputs.F: .*the name of a column or {column, interpolation, time}.*3"),
    ({"time": None}, "either time .*or sample_time .*neither"),
    ({"time": 3}, "time: .*text.*3"),
    ({"sample_time": 1.0}, "either time .*or sample_time .*both"),
    ({"sigma": {"q": 1.0}}, "sigma.q: .*one of the outputs"),
    ({"sigma": 0.0}, "sigma.y: .*greater than 0.*0"),
    ({"sigma": 10**400}, "sigma.y: .*a finite number that fits into a double.*1000"),
    ({"relative_sigma": 0.1}, "relative_sigma.y: .*given together with sigma.y"),
    ({"sigma": 0.1, "relative_sigma": -0.1}, "relative_sigma.y: .*at least 0.*-0.1"),
    ({"relative_sigma": {"q": 1.0}}, "relative_sigma.q: .*one of the outputs"),
    ({"columns": {"force": {"factr": 1}}}, "columns.force: unknown key factr.*did you mean"),
    ({"columns": {"force": 3}}, "columns.force: .*a dict.*3"),
    ({"columns": {"force": {"factor": "3"}}}, "columns.force.factor: .*a number.*'3'"),
    ({"columns": {"force": {"demean": 1}}}, "columns.force.demean: .*true or false.*1"),
    ({"columns": 3}, "columns: .*a dict.*3; write {column: {factor, offset, demean, late}}"),
    ({"rows": (2, 1)}, r"rows: .*from below to.*\[2, 1\]"),
    ({"rows": 3}, r"rows: .*a Sequence.*3; write \(from, to\)"),
    ({"rows": (1, 2), "time": None, "sample_time": 1.0}, "at least two rows"),
    ({"start": "0"}, "start: .*a number.*'0'"),
    ({"values": "m"}, "values: .*a dict.*'m'; write {name: value}"),
    ({"values": {3: 1.0}}, r"values: .*pairs \(name, value\).*\(3, 1.0\)"),
    ({"values": {"m": 10**400}}, "values.m: .*a finite number, true, false or text"),
    ({"id": ""}, "experiment.id: .*not be empty"),
    (of_y(interpolation="hold"), "outputs.y: unknown key interpolation"),
    (of_y(free_scale="shared"), "output 'y'.free_scale: .*true or false.*'shared'"),
    (of_y(detection_limit="0"), "output 'y'.detection_limit: .*a number.*'0'"),
    (of_y(ordinal=True, free_scale=True), "ordinal: .*not be used with free_scale"),
    (of_y(ordinal="low"), "ordinal: .*true or false.*'low'"),
    (of_y(ordinal=["low", 3]), r"outputs.y.ordinal\[1\]: .*text.*3"),
    (of_y(ordinal=["low", "high"]), "the listed words, but holds numbers"),
]


@pytest.mark.parametrize(("change", "pattern"), REFUSED)
def test_what_is_wrong_is_said(change, pattern):
    with pytest.raises(DataError, match=pattern):
        ce.Experiment.from_table(COLUMNS, **GIVEN | change)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (COLUMNS | {"position": [1.0]}, "must have as many rows as the time column, 4, but has 1"),
        (COLUMNS | {"force": [1, "a", 2.0, 3]}, "column 'force': must hold numbers, but cannot be"),
        (COLUMNS | {"force": [10**400, 1, 2, 3]}, "'force': must hold numbers, but cannot be"),
        (COLUMNS | {"force": COLUMNS["when"]}, "must hold numbers, but holds duration"),
        (
            pd.DataFrame([[0, 1, 2], [1, 2, 3], [2, 3, 4]], columns=["t", "force", "force"]),
            "must occur once, but 2 columns have that name",
        ),
        (3, "must be a pandas, polars or pyarrow table, a dict of columns or a path"),
        ("missing.csv", "there is no file missing.csv; check the path"),
    ],
)
def test_a_wrong_table_is_said(table, said):
    given = GIVEN | {"outputs": {"y": "force"}} if isinstance(table, pd.DataFrame) else GIVEN
    with pytest.raises(DataError, match=said):
        ce.Experiment.from_table(table, **given)


FACTORS = {
    ("kg/min", "kg/s"): 1.0 / 60.0,
    ("l/min", "m3/s"): 1e-3 / 60.0,
    ("m³/h", "l/s"): 1.0 / 3.6,
    ("km/h", "m/s"): 1.0 / 3.6,
    ("rpm", "rad/s"): 0.10471975511966,
    ("rev", "deg"): 360.0,
    ("mm/s^2", "m/s2"): 1e-3,
    ("J/(kg.K)", "kJ/kg/K"): 1e-3,
    ("W/m2/K", "W/(m2.K)"): 1.0,
    ("degC/min", "K/s"): 1.0 / 60.0,
    ("Nm", "kN.m"): 1e-3,
    ("mAh", "C"): None,
    ("Ah", "A.s"): 3600.0,
    ("mmol/l", "mol/m3"): 1.0,
    ("kWh", "J"): 3.6e6,
    ("%", "1"): 0.01,
    ("kg/min", "m3/s"): None,
    ("parsec", "m"): None,
    ("kg/", "kg"): None,
}


@pytest.mark.parametrize(("given", "wanted"), FACTORS)
def test_products_and_quotients_are_converted_by_their_parts(given, wanted):
    factor = FACTORS[given, wanted]
    found = conversion(given, wanted)
    if factor is None:
        assert found is None
    else:
        assert found is not None
        assert found.factor == pytest.approx(factor, rel=1e-9)
        assert found.offset == 0.0


@pytest.mark.parametrize(
    ("given", "wanted", "number", "expected"),
    [("°C", "K", 25.0, 298.15), ("degF", "degC", 212.0, 100.0), ("K", "degC", 0.0, -273.15)],
)
def test_temperatures_have_an_offset(given, wanted, number, expected):
    found = conversion(given, wanted)
    assert found is not None
    assert found.factor * number + found.offset == pytest.approx(expected)


def test_words_are_no_units():
    assert not any(is_known(word) for word in ("", "10", "flow", "kgs", "kg/x", "/s", "m/"))
    assert all(is_known(unit) for unit in ("1", "kg/min", "1/s", "W/(m2.K)", "km/h"))
    assert same_unit("m/s^2", "m/s²")


WHEN = pd.Timestamp("2026-03-29 00:59:58", tz="UTC") + pd.to_timedelta(COLUMNS["t"], unit="s")
TIMES = {
    "datetimes with a zone": WHEN.tz_convert("Europe/Berlin"),
    "datetimes": WHEN.tz_localize(None),
    "numpy": WHEN.tz_localize(None).to_numpy(),
    "numpy in milliseconds": WHEN.tz_localize(None).to_numpy().astype("datetime64[ms]"),
    "seconds since 1970": WHEN.as_unit("ns").asi8 / 1e9,
    "nanoseconds since 1970": WHEN.as_unit("ns").asi8,
    "durations": pd.to_timedelta(COLUMNS["t"], unit="s"),
    "texts": [str(each) for each in WHEN],
    "Python's own": list(WHEN.to_pydatetime()),
    "times of day": [each.time() for each in WHEN],
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_count_from_the_first_row(kind):
    found = ce.Experiment.from_table(COLUMNS | {"t": TIMES[kind]}, **GIVEN)
    np.testing.assert_allclose(found.inputs[0].times, COLUMNS["t"], atol=1e-6)
    assert found.outputs[0].times[0] == 0.0
    rows = ce.Experiment.from_table(COLUMNS | {"t": TIMES[kind]}, **GIVEN, rows=(2, 4))
    first = 1.0 if kind == "durations" else 0.0
    np.testing.assert_allclose(rows.inputs[0].times, [first, first + 0.5], atol=1e-6)


FAST, SLOW = np.arange(41) * 0.05, 0.02 + np.arange(20) * 0.1
CHANNELS = {"time": "t", "inputs": {"F": "force"}, "outputs": {"y": "position"}, "id": "a"}


def channels(folder, later=0.0):
    """Two channels of one test, each with its own times: as tables, as files, and their names."""
    tables = [
        {"t": FAST, "force": np.sin(FAST)},
        {"t": SLOW + later, "position": np.cos(SLOW)},
    ]
    files = [folder / "run_f.csv", folder / "run_p.csv"]
    for table, file in zip(tables, files, strict=True):
        pd.DataFrame(table).to_csv(file, index=False)
    frames = [pd.DataFrame(table) for table in tables]
    return {"dicts": tables, "frames": frames, "files": files, "names": [*map(str, files)],
            "both": (frames[0], files[1])}  # fmt: skip


@pytest.mark.parametrize("kind", ["dicts", "frames", "files", "names", "both"])
def test_tables_of_one_test_keep_their_own_times(tmp_path, kind):
    found = ce.Experiment.from_table(channels(tmp_path)[kind], **CHANNELS)
    np.testing.assert_allclose(found.inputs[0].times, FAST, atol=1e-9)
    np.testing.assert_allclose(found.outputs[0].times, SLOW, atol=1e-9)
    np.testing.assert_allclose(found.outputs[0].values, np.cos(SLOW))


def test_a_factor_of_their_time_is_applied_once(tmp_path):
    tables = [{**each, "t": 1e3 * each["t"]} for each in channels(tmp_path)["dicts"]]
    changes = {"t": {"factor": 1e-3}, "position": {"factor": 10.0}}
    found = ce.Experiment.from_table(tables, **CHANNELS, columns=changes)
    np.testing.assert_allclose(found.inputs[0].times, FAST, atol=1e-9)
    np.testing.assert_allclose(found.outputs[0].times, SLOW, atol=1e-9)
    np.testing.assert_allclose(found.outputs[0].values, 10.0 * np.cos(SLOW))


def test_a_column_of_several_tables_has_the_part_of_its_file_or_the_number(tmp_path):
    tables = [{"t": t, "value": np.sin(t)} for t in (FAST, SLOW)]
    given = CHANNELS | {"inputs": {"F": "1.value"}, "outputs": {"y": "2.value"}}
    found = ce.Experiment.from_table(tables, **given)
    np.testing.assert_allclose(found.outputs[0].values, np.sin(SLOW))


@pytest.mark.parametrize(
    ("later", "said"),
    [(1.5, "table 2 were 1.52 s ahead; nothing was corrected"), (-0.02, "begin at 0")],
)
def test_clocks_that_may_differ_are_a_warning(tmp_path, later, said):
    with pytest.warns(UserWarning, match=f"experiment 'a': .*{said}"):
        ce.Experiment.from_table(channels(tmp_path, later)["dicts"], **CHANNELS)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time": None, "sample_time": 0.1}, "need time, and no rows, but time is None"),
        ({"rows": (0, 5)}, r"and rows is \(0, 5\)"),
        ({"time": "when"}, "every file of a test needs this column"),
    ],
)
def test_tables_of_one_test_need_their_times(tmp_path, change, said):
    with pytest.raises(DataError, match=said):
        ce.Experiment.from_table(channels(tmp_path)["frames"], **CHANNELS | change)


def test_tables_without_a_common_time_are_refused(tmp_path):
    with pytest.raises(DataError, match="no time in common"):
        ce.Experiment.from_table(channels(tmp_path, 5.0)["dicts"], **CHANNELS)


def test_an_index_of_times_without_a_name_is_a_column():
    frame = pd.DataFrame(COLUMNS, index=WHEN).drop(columns="t")
    found = ce.Experiment.from_table(frame, **GIVEN | {"time": "index"})
    assert found.inputs[0].times.tolist() == COLUMNS["t"]


def test_a_column_has_times_of_its_own_where_they_are_named():
    table = COLUMNS | {"slow": [0.0, 1.0, None, None], "position": [1.0, 2.0, None, None]}
    outputs = {"y": {"column": "position", "time": "slow"}}
    found = ce.Experiment.from_table(table, **GIVEN | {"outputs": outputs})
    assert found.outputs[0].times.tolist() == [0.0, 1.0]
    assert found.inputs[0].times.tolist() == COLUMNS["t"]
    late = table | {"position": [1.0, 2.0, 3.0, None]}
    with pytest.raises(DataError, match="row 3: must have a time for each value"):
        ce.Experiment.from_table(late, **GIVEN | {"outputs": outputs})


@pytest.mark.parametrize(
    ("reading", "said"),
    [
        ({"encoding": "utf-16"}, "UTF-16"),
        (
            {"encoding": "no such"},
            "must have an encoding that Python knows, but encoding is 'no such'",
        ),
        ({"encodin": "utf-8"}, "reading: unknown key encodin; did you mean 'encoding'"),
        ({"skip_rows": -1}, "reading.skip_rows: must be"),
        ({"skip_rows": 99}, "must have more lines than skip_rows, which is 99"),
        ({"decimal": "'"}, 'reading.decimal: must be "." or ","'),
        ({"long": ["a"]}, "reading.long: must be the names of two columns"),
        ({"sheet": "A"}, "sheet: has no meaning for .* whose format is csv"),
        (3, "reading"),
    ],
)
def test_what_is_said_of_a_file_is_checked(tmp_path, reading, said):
    with pytest.raises(DataError, match=said):
        ce.read_table(written(tmp_path), reading=reading).numbers("t", "here")
