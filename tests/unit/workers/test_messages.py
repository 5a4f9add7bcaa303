import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from workers.errors import DataError, EffectError, ModelError
from workers.messages import (
    Curve,
    Effect,
    Experiment,
    Input,
    Model,
    Output,
    SignalBound,
    Solver,
    UserFunction,
)
from workers.messages.checks import told_apart
from workers.messages.signals import check_times

T = np.linspace(0.0, 1.0, 5)
DRIVEN, MEASURED = Input("F", T, T), Output("y", T, T)


def refusal(times, *, of_rows=True):
    with pytest.raises(DataError) as error:
        check_times(np.asarray(times, float), "run", "row {}".format, of_rows=of_rows)
    return str(error.value)


def set_back(amount, times, at=300):
    """Times of a clock that was set back once."""
    return np.where(np.arange(len(times)) < at, times, times - amount)


EVEN = 0.01 * np.arange(600)
JITTERED = np.cumsum(0.01 * (1.0 + 0.5 * np.random.default_rng(0).uniform(-1.0, 1.0, 600)))
MILLISECONDS = np.round(np.arange(600) / 300.0, 3)  # a step of 3.33 ms, rounded


class TestTimes:
    @pytest.mark.parametrize(
        ("times", "said"),
        [
            (set_back(1.0, EVEN), "back by about 1 s; do not sort.*give sample_time = 0.01,"),
            (set_back(0.503, EVEN), "back by about 0.503 s; do not sort.*sample_time = 0.01,"),
            (set_back(0.5, MILLISECONDS), "do not sort.*give sample_time = 0.00333"),
            (
                set_back(1.0, JITTERED),
                r"do not sort.*add (0\.99|1|1\.0)\d* to the times from there",
            ),
            (
                set_back(1.0, np.delete(EVEN, np.r_[400:450])),
                "do not sort.*but correct the times there",
            ),
            (
                np.r_[EVEN[:300], 2.0, EVEN[301:]],
                "^run, row 300: .*the time of row 300 is wrong, 2: correct it, or remove the row$",
            ),
            (np.r_[EVEN[:300], 0.0, EVEN[301:]], "; .*the time of row 300 is wrong, 0: correct"),
            (np.r_[EVEN[:5], 0.0, EVEN[6:9]], "the time of row 5 is wrong, 0: correct"),
            (
                np.r_[EVEN[:300], 9e9, EVEN[301:]],
                "^run, row 301: .*the time of row 300 is wrong, 9e[+]09: correct",
            ),
            (
                np.r_[JITTERED[:300], 0.0, 0.0, 0.0, JITTERED[303:400], 99.0, JITTERED[401:]],
                r"the time of row 300 \(and of 3 more rows\) is wrong, 0: correct",
            ),
            (np.r_[EVEN, 0.0], "the time of row 600 is wrong, 0: correct"),
            (np.r_[99.0, EVEN], "the time of row 0 is wrong, 99: correct"),
            (np.r_[EVEN[:300], EVEN[301:400], EVEN[300], EVEN[400:]], "; sort the rows"),
            (np.r_[EVEN[:8], EVEN], "begins again there, as in a file with several tests"),
            (np.r_[EVEN, EVEN, EVEN], "begins again there, as in a file with several tests"),
            (np.r_[EVEN[300:], EVEN[:300]], "; sort the rows and remove repeated ones$"),
            (set_back(0.505, EVEN), "do not sort.*give sample_time = 0.01,"),
            (np.r_[EVEN[:300], EVEN[310:400], EVEN[300:310], EVEN[400:]], "; sort the rows"),
            (EVEN[np.random.default_rng(1).permutation(600)], "; sort the rows"),
            (np.sort(np.r_[EVEN, EVEN[::50]]), "; remove the repeated rows$"),
            (EVEN[::-1], "; reverse the order of the rows$"),
            (np.floor(EVEN), "many rows have the same time, so give sample_time,"),
        ],
    )
    def test_advice_agrees_with_the_order_of_the_rows(self, times, said):
        assert re.search(said, refusal(times))

    @pytest.mark.parametrize("times", [set_back(1.0, EVEN), np.r_[EVEN, EVEN], np.floor(EVEN)])
    def test_times_without_rows_are_not_advised_to_change_keys(self, times):
        assert "sample_time" not in refusal(times, of_rows=False)
        assert "sort the rows and" not in refusal(times, of_rows=False)


class TestSamples:
    def test_what_is_kept_is_its_own_and_cannot_be_written_to_and_is_copied_once(self):
        times, values = T.copy(), T.copy()
        view = values[:]
        view.flags.writeable = False
        kept, seen = Input("F", times, values), Output("F", T, view)
        times += 1.0
        values *= 2.0
        for signal in (kept, seen):
            np.testing.assert_array_equal(signal.times, T)
            np.testing.assert_array_equal(signal.values, T)
        with pytest.raises(ValueError, match="read-only"):
            kept.values[0] = 3.0
        assert Input("F", kept.times, kept.values).values is kept.values

    @pytest.mark.parametrize(
        "given",
        [
            [1, 2],
            (1.0, 2.0),
            np.array([1, 2], np.int8),
            np.array([1.0, 2.0], ">f4"),
            np.array([1, 2], object),
            pd.Series([1, 2], index=[7, 8]),
            pd.Series([1, 2], dtype="Int64"),
            pa.array([1, 2]),
        ],
    )
    def test_what_holds_numbers_becomes_floats(self, given):
        values = Output("y", [0, 1], given).values
        assert values.dtype == np.float64
        assert values.tolist() == [1.0, 2.0]

    @pytest.mark.parametrize(
        ("times", "values", "said"),
        [
            ([0, 2, 1], [1, 2, 3], "times, index 2.*must increase.*1 goes back from 2"),
            ([0, 1, 1], [1, 2, 3], "times, index 2.*must increase.*1 repeats 1"),
            ([0, np.nan], [1, 2], "times, index 1.*must be a finite number.*nan"),
            ([0, 1], [1, np.nan], "values, index 1.*must be a finite number.*nan; correct it"),
            ([0, 1], [1, None], "values, index 1.*must be a finite number.*nan"),
            ([0, 1], pd.Series([1, pd.NA]), "values, index 1.*must be a finite number.*nan"),
            ([0, 1], np.ma.array([1, 2], mask=[1, 0]), "values, index 0.*must be a finite"),
            ([0, 1], [1, -np.inf], "values, index 1.*must be a finite number.*-inf"),
            ([0, 1], [1], "values.*must have as many rows as the time column, 2,.*1"),
            ([0, 1], ["1", "2"], "values.*must contain numbers.*<U1; convert it"),
            ([0, 1], np.array([1, "b"], object), r"values\[1\].*must be a number.*'b'"),
            ([0, 1], [1, 2j], "values.*must contain numbers.*complex128"),
            ([0, 1], [[1], [2]], r"values.*must be a list of numbers.*\(2, 1\)"),
            ([0, 1], [[1], [2, 3]], "values.*must contain numbers.*cannot be read"),
            (0, 1, "times.*must be a list of numbers.*a single number"),
            ([10**400, 0], [0, 1], r"times.*must contain numbers.*int too large"),
            (None, T, "times.*must be a list of numbers.*None"),
            (T, {"a": 1}, "values.*must be a list of numbers.*{'a': 1}"),
            (T, {1.5}, "values.*must be a list of numbers.*{1.5}"),
            (T, "abc", "values.*must be a list of numbers.*'abc'"),
            (pd.date_range("2020", periods=2), [1, 2], "times.*must contain numbers.*datetime64"),
        ],
    )
    def test_what_is_no_measurement_is_refused(self, times, values, said):
        for kind, where in ((Input, "input"), (Output, "output")):
            with pytest.raises(DataError, match=f"^{where} 'y'.{said}"):
                kind("y", times, values)

    def test_an_input_has_samples_and_an_output_may_have_none_left(self):
        with pytest.raises(DataError, match=r"input 'F': must have at least one sample"):
            Input("F", [], [])
        assert len(Output("y", [], []).times) == 0

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            *(("sigma", value) for value in (0, -1.0, np.nan, np.inf, "1", None, T, True)),
            *(("relative_sigma", value) for value in (-0.1, np.nan, np.inf, "1", None, True)),
        ],
    )
    def test_what_is_no_size_of_noise_is_refused(self, name, value):
        with pytest.raises(DataError, match=rf"output 'y'\.{name}: must be "):
            Output("y", T, T, **{"sigma": 1.0, name: value})

    def test_noise_that_grows_has_a_sigma_for_each_sample(self):
        output = Output("y", [0.0, 1.0, 2.0], [0.0, -4.0, 30.0], 0.3, 0.1)
        np.testing.assert_allclose(output.sigmas, [0.3, 0.5, np.sqrt(9.09)], rtol=1e-14)
        plain = Output("y", [0.0, 1.0, 2.0], [0.0, -4.0, 30.0], 0.3)
        assert plain.sigmas.tolist() == [0.3, 0.3, 0.3]
        assert [o.has_sigma for o in (output, plain, Output("y", T, T))] == [True, True, False]
        keys = {Experiment("e", 0.0, 2.0, (), (each,)).key for each in (output, plain)}
        assert len(keys) == 2

    def test_other_arguments_than_the_usual_ones_are_seen(self):
        with pytest.raises(DataError, match=r"input\.variable: must be text.*array"):
            Input(T, T, "F")
        with pytest.raises(DataError, match=r"must be 'linear' or 'hold'.*'cubic'"):
            Input("F", T, T, "cubic")


def test_lists_and_dicts_make_the_same_experiment_as_tuples():
    plain = Experiment("a", 0.0, 1.0, (DRIVEN,), (MEASURED,), (("m", 1.0),))
    listed = Experiment("a", 0.0, 1.0, [DRIVEN], [MEASURED], {"m": 1.0})
    assert listed.key == plain.key
    assert listed.values == plain.values


def test_lists_make_a_curve_whose_samples_may_be_fewer_than_its_points():
    curve = Curve(["x"], [[0], [1], [0]], [0, 1], [2])
    assert (curve.variables, curve.tolerances) == (("x",), (2.0,))
    assert curve.points.tolist() == [[0.0], [1.0], [0.0]]
    assert curve.names == ("tolerance of x",)


def test_arrays_of_curves_and_bounds_are_their_own():
    points, lower = np.zeros((3, 1)), np.zeros(5)
    curve = Curve(("x",), points, T)
    bound = SignalBound("b", "y", T, lower, [np.inf] * 5)
    points[0] = lower[0] = 1.0
    assert curve.points[0] == bound.lower[0] == 0.0
    kept = (curve.points, curve.times, bound.times, bound.lower, bound.upper)
    assert not any(each.flags.writeable for each in kept)


EXPERIMENT = {"id": "a", "start": 0.0, "stop": 1.0, "inputs": [DRIVEN], "outputs": [MEASURED]}
CURVE = {"variables": ("x", "v"), "points": [[0, 1], [1, 2], [0, 3]], "times": T}
BOUND = {"name": "b", "variable": "y", "times": [0, 1], "lower": [0, 1], "upper": [2, 2]}
FUNCTION = {"module": "m", "name": "f"}
MODEL = {"name": "a.fmu", "archive": b"", "interface": "model_exchange"}
MODEL |= {"solver": Solver("rk4"), "parameters": ("m",)}
RK4 = {"name": "rk4"}
EFFECT = {"name": "f", "site": "der(v)"}


@pytest.mark.parametrize(
    ("kind", "given", "change", "said"),
    [
        *(
            (Experiment, EXPERIMENT, *each)
            for each in [
                ({"inputs": DRIVEN}, "'a'.inputs: must be a list of Input.*a single one"),
                ({"inputs": [MEASURED]}, r"'a'.inputs\[0\]: must be an Input.*Output"),
                ({"start": 2.0}, "'a'.start: must be before stop, which is 1 s,.*2 s; change one"),
                ({"start": "0"}, "'a'.start: must be a number.*'0'"),
                ({"stop": np.nan}, "'a'.stop: must be a finite number.*nan"),
                ({"stop": 10**400}, "'a'.stop: must be a finite number.*1000"),
                ({"stop": 0.5}, "'a'.outputs.y: .* must lie between start and stop, 0 to 0.5 s"),
                ({"start": 0.5}, "'a'.outputs.y: .* must lie between start and stop, 0.5 to 1 s"),
                (
                    {"stop": 1.0 - 2**-53},
                    "and stop, 0 to 0.9999999999999999 s, but go from 0 to 1 s",
                ),
                ({"start": 1.0 + 2**-52}, "stop, which is 1 s, but is 1.0000000000000002 s"),
                ({"curve": Curve(("y",), [[0], [1]], [0, 2])}, "'a'.curve: .*from 0 to 2 s"),
                (
                    {"bounds": [SignalBound("b", "y", [-1, 0], [0, 0], [1, 1])]},
                    "'a'.bounds.b: .* must lie between start and stop, 0 to 1 s.*from -1 to",
                ),
                ({"curve": T}, "'a'.curve: must be a Curve.*array"),
                ({"cost_function": 3}, "'a'.cost_function: must be a UserFunction.*3"),
                ({"constraint_functions": [3]}, r"'a'.constraint_functions\[0\]: must be a User"),
                ({"role": "training"}, "'a'.role: must be 'train' or 'test'.*'training'"),
                ({"values": {"m": np.nan}}, "'a'.values.m: must be a finite number"),
                ({"values": {"m": 10**400}}, "'a'.values.m: must be a finite number"),
                ({"values": "m"}, "'a'.values: must be a dict.*'m'; write"),
                ({"values": [("m", 1, 2)]}, r"'a'.values: must contain pairs \(name, value\)"),
                ({"values": {1: 2.0}}, r"'a'.values: must contain pairs.*\(1, 2.0\)"),
                ({"groups": 1}, "'a'.groups: must be a dict.*1"),
                ({"outputs": [MEASURED] * 2}, "'a'.outputs 'y': must appear once.*twice"),
                *(({"id": id_}, r"experiment\.id: must") for id_ in (1, "", None)),
            ]
        ),
        *(
            (Curve, CURVE, *each)
            for each in [
                ({"variables": ()}, "variables: must name at least one.*none"),
                ({"variables": "x"}, "variables: must be a list of text.*a single one"),
                ({"variables": ("x", "")}, r"variables\[1\]: must not be empty"),
                (
                    {"variables": ("x",)},
                    "points: must have a column for each of the 1 variables,.*2",
                ),
                ({"points": [[0, 1]]}, "points: must have at least two rows .*but has 1"),
                ({"points": [0, 1]}, r"points: must be a table of numbers.*\(2,\)"),
                ({"points": "a"}, "points: must be a table of numbers.*'a'"),
                ({"points": [[0, 1], [0, np.nan]]}, "points of 'v', index 1: must be a finite"),
                ({"times": [1, 0]}, "times, index 1.*must increase.*0 goes back from 1"),
                ({"times": [0, np.inf]}, "times, index 1.*must be a finite number.*inf"),
                ({"times": []}, "times: must have at least one time, but has none"),
                (
                    {"tolerances": (1.0,)},
                    "tolerances: must have a number for each of the 2 variables,.*1",
                ),
                ({"tolerances": (1, -1)}, "tolerances of 'v': must be at least 0.*-1"),
                ({"tolerances": (np.nan, 1)}, "tolerances of 'x': must be a finite.*nan"),
                ({"tolerances": 0.1}, "tolerances: must be a list of numbers.*a single number"),
            ]
        ),
        *(
            (SignalBound, BOUND, *each)
            for each in [
                ({"variable": 1}, "'b'.variable: must be text.*1"),
                ({"times": [1, 0]}, "'b'.times, index 1.*must increase.*0 goes back from 1"),
                ({"times": [1, 1]}, "'b'.times, index 1.*must increase.*1 repeats 1"),
                ({"times": []}, "'b'.times: must have at least one time"),
                ({"times": [0]}, "'b'.lower: must have as many rows as the time column, 1,.*2"),
                (
                    {"upper": [2, 2, 2]},
                    "'b'.upper: must have as many rows as the time column, 2,.*3",
                ),
                ({"lower": [0, 3]}, "'b'.lower, index 1: must not be above upper.*3 and 2"),
                ({"lower": [0, np.nan]}, "'b'.lower, index 1: must be a finite.*or -inf"),
                ({"upper": [-np.inf, 0]}, "'b'.upper, index 0: must be a finite.*or inf"),
                ({"lower": 0.0}, "'b'.lower: must be a list of numbers.*a single number"),
                ({"upper": "high"}, "'b'.upper: must be a list of numbers.*'high'"),
                ({"upper": ["a", "b"]}, "'b'.upper: must contain numbers.*<U1"),
                ({"scale": 0}, "'b'.scale: must be greater than 0.*0"),
                ({"scale": "a"}, "'b'.scale: must be a number.*'a'"),
                ({"equality": "no"}, "'b'.equality: must be true or false.*'no'"),
                ({"equality": True}, "'b'.lower, index 0: must be equal to upper,.*equality"),
                ({"lower": [0, -np.inf], "equality": True}, "'b'.lower, index 1: .*finite.*-inf"),
                ({"name": ""}, r"bound\.name: must not be empty"),
            ]
        ),
        (UserFunction, FUNCTION, {"module": len}, "function.module: must be text.*len"),
        (UserFunction, FUNCTION, {"name": ""}, "function.name: must not be empty"),
        (UserFunction, FUNCTION, {"source": None}, "'f'.source: must be text.*None"),
        (UserFunction, FUNCTION, {"equality": 1}, "'f'.equality: must be true or false.*1"),
    ],
)
def test_data_that_contradict_themselves_are_refused(kind, given, change, said):
    with pytest.raises(DataError, match=f"^(experiment|curve|bound|function).*{said}|^{said}"):
        kind(**given | change)


@pytest.mark.parametrize(
    ("kind", "given", "change", "said"),
    [
        (Model, MODEL, {"interface": "modelexchange"}, "interface: must be 'model_exchange' or"),
        (Model, MODEL, {"archive": "a.fmu"}, r"archive: must be the bytes.*use.*read_model\("),
        (Model, MODEL, {"archive": Path("a.fmu")}, "archive: must be the bytes.*the path"),
        (Model, MODEL, {"archive": 3}, "archive: must be a bytes.*3"),
        (Model, MODEL, {"solver": "cvode"}, r"must be a Solver.*'cvode'; write Solver\('cvode'\)"),
        (Model, MODEL, {"solver": Solver("fmu")}, "dormand_prince, rk4 or cvode for model_ex"),
        (Model, MODEL, {"parameters": "m"}, "parameters: must be a list of text.*a single one"),
        (Model, MODEL, {"parameters": [1]}, r"parameters\[0\]: must be text.*1"),
        (Model, MODEL, {"reset": "never"}, "reset: must be 'auto', 'reset', 'instance' or 'proc"),
        (Solver, RK4, {"name": "ode45"}, "solver: must be 'dormand_prince', .* or 'fmu'"),
        (Solver, RK4, {"step": 0}, "step: must be greater than 0.*0"),
        (Solver, RK4, {"rtol": "1e-3"}, "rtol: must be a number.*'1e-3'"),
        (Solver, RK4, {"rtol": 1.0}, "rtol: must be less than 1.*1"),
        (Solver, RK4, {"max_steps": 1e6}, "max_steps: must be a whole number.*1000000"),
    ],
)
def test_a_model_or_solver_that_cannot_be_is_refused(kind, given, change, said):
    with pytest.raises(ModelError, match=f"^model.*{said}"):
        kind(**given | change)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": 1}, r"effect\.name: must be text.*1"),
        ({"variables": "x"}, "'f'.variables: must be a list of text"),
        ({"form": 3}, "'f'.form: must be text.*3"),
        ({"equation": 3}, "'f'.equation: must be text.*3"),
        ({"reaction": None}, "'f'.reaction: must be text.*None"),
        ({"coefficients": {"a": "0"}}, "'f'.coefficients.a: must be a number.*'0'"),
    ],
)
def test_an_effect_is_made_of_texts_and_numbers(change, said):
    with pytest.raises(EffectError, match=f"^(effect )?{said}"):
        Effect(**EFFECT | change)


@pytest.mark.parametrize(
    ("numbers", "texts"),
    [
        ((0.5, 1.0, 1e9), ["0.5", "1", "1e+09"]),
        ((0.1, 0.1), ["0.1", "0.1"]),
        ((1.0, 1.0 + 2**-52), ["1", "1.0000000000000002"]),
        ((1234567.0, 1234568.0, np.inf), ["1234567", "1234568", "inf"]),
        ((np.float64(0.1), np.nan), ["0.1", "nan"]),
    ],
)
def test_different_numbers_look_different(numbers, texts):
    assert told_apart(*numbers) == texts


def test_models_and_experiments_are_shown_in_a_few_words():
    signals = [Input(f"signal_{i}", T, T) for i in range(30)]
    many = replace(Experiment(**EXPERIMENT), inputs=signals)
    assert repr(Experiment(**EXPERIMENT)) == "Experiment(a: F -> y; 0 to 1 s; train)"
    assert repr(many) == (
        "Experiment(a: signal_0, signal_1, signal_2, signal_3 and 26 more -> y; 0 to 1 s; train)"
    )
    names = [f"a_very_long_name_of_a_parameter_{i}" for i in range(30)]
    model = Model("a.fmu", b"PK", "model_exchange", Solver("cvode"), names)
    assert repr(model) == f"Model(a.fmu: {names[0]} and 29 more; model_exchange, cvode)"
    assert max(len(repr(each)) for each in (many, model)) <= 120
