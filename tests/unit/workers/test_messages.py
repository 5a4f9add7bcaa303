"""Signals, experiments, models and solvers refuse what is none, in a sentence."""

from __future__ import annotations

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

T = np.linspace(0.0, 1.0, 5)
DRIVEN, MEASURED = Input("F", T, T), Output("y", T, T)


class TestSamples:
    @pytest.mark.parametrize("kind", [Input, Output])
    def test_a_buffer_that_is_filled_again_changes_nothing(self, kind):
        times, values = T.copy(), T.copy()
        view = values[:]
        view.flags.writeable = False
        kept, seen = kind("F", times, values), kind("F", T, view)
        times += 1.0
        values *= 2.0
        for signal in (kept, seen):
            np.testing.assert_array_equal(signal.times, T)
            np.testing.assert_array_equal(signal.values, T)

    def test_what_is_kept_cannot_be_written_to_and_is_copied_once(self):
        kept = Input("F", T, T)
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
            ([0, 2, 1], [1, 2, 3], "times, index 2: times must increase but 1 goes back from 2"),
            ([0, 1, 1], [1, 2, 3], "times, index 2: times must increase but 1 repeats 1"),
            ([0, np.nan], [1, 2], "times, index 1: the time must be a finite number but is nan"),
            ([0, 1], [1, np.nan], "values, index 1: must be a finite number but is nan; mend it"),
            ([0, 1], [1, None], "values, index 1: must be a finite number but is nan; mend it"),
            ([0, 1], pd.Series([1, pd.NA]), "values, index 1: must be a finite number but is nan"),
            ([0, 1], np.ma.array([1, 2], mask=[1, 0]), "values, index 0: must be a finite number"),
            ([0, 1], [1, -np.inf], "values, index 1: must be a finite number but is -inf"),
            ([0, 1], [1], "values: must have as many rows as the time, 2, but has 1"),
            ([0, 1], ["1", "2"], "values: must hold numbers but holds <U1; convert it"),
            ([0, 1], np.array([1, "b"], object), r"values\[1\]: must be a number but is 'b'"),
            ([0, 1], [1, 2j], "values: must hold numbers but holds complex128"),
            ([0, 1], [[1], [2]], r"values: must be a list of numbers but is of shape \(2, 1\)"),
            ([0, 1], [[1], [2, 3]], "values: must hold numbers but cannot be read"),
            (0, 1, "times: must be a list of numbers but is a number alone"),
            ([10**400, 0], [0, 1], r"times: must hold numbers but does not \(int too large"),
            (None, T, "times: must be a list of numbers but is None"),
            (T, {"a": 1}, "values: must be a list of numbers but is {'a': 1}"),
            (T, {1.5}, "values: must be a list of numbers but is {1.5}"),
            (T, "abc", "values: must be a list of numbers but is 'abc'"),
            (
                pd.date_range("2020", periods=2),
                [1, 2],
                r"times: must hold numbers but holds datetime64",
            ),
        ],
    )
    @pytest.mark.parametrize("kind", [Input, Output])
    def test_what_is_no_measurement_is_refused(self, kind, times, values, said):
        with pytest.raises(DataError, match=f"^(input|output) 'y'.{said}"):
            kind("y", times, values)

    def test_an_input_has_samples(self):
        with pytest.raises(DataError, match=r"input 'F': must have at least one sample"):
            Input("F", [], [])

    def test_an_output_may_have_none_left(self):
        assert len(Output("y", [], []).times) == 0

    @pytest.mark.parametrize("sigma", [0, -1.0, np.nan, np.inf, "1", None, T, True])
    def test_sigma_is_a_positive_number(self, sigma):
        with pytest.raises(DataError, match=r"output 'y'\.sigma: must be "):
            Output("y", T, T, sigma)

    @pytest.mark.parametrize("part", [-0.1, np.nan, np.inf, "1", None, True])
    def test_relative_sigma_is_a_number_from_zero(self, part):
        with pytest.raises(DataError, match=r"output 'y'\.relative_sigma: must be "):
            Output("y", T, T, 1.0, part)

    def test_noise_that_grows_has_a_sigma_for_each_sample(self):
        output = Output("y", [0.0, 1.0, 2.0], [0.0, -4.0, 30.0], 0.3, 0.1)
        np.testing.assert_allclose(output.sigmas, [0.3, 0.5, np.sqrt(9.09)], rtol=1e-14)
        plain = Output("y", [0.0, 1.0, 2.0], [0.0, -4.0, 30.0], 0.3)
        assert plain.sigmas.tolist() == [0.3, 0.3, 0.3]
        assert [o.has_sigma for o in (output, plain, Output("y", T, T))] == [True, True, False]
        keys = {Experiment("e", 0.0, 2.0, (), (each,)).key for each in (output, plain)}
        assert len(keys) == 2

    def test_arguments_in_another_order_are_seen(self):
        with pytest.raises(DataError, match=r"input\.variable: must be text but is array"):
            Input(T, T, "F")

    def test_the_interpolation_is_one_of_two(self):
        with pytest.raises(DataError, match="must be 'linear' or 'hold' but is 'cubic'"):
            Input("F", T, T, "cubic")


class TestExperiment:
    def test_lists_and_dicts_make_the_same_as_tuples(self):
        plain = Experiment("a", 0.0, 1.0, (DRIVEN,), (MEASURED,), (("m", 1.0),))
        listed = Experiment("a", 0.0, 1.0, [DRIVEN], [MEASURED], {"m": 1.0})
        assert listed.key == plain.key
        assert listed.values == plain.values

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"inputs": DRIVEN}, "inputs: must be a list of Input but is one alone"),
            ({"inputs": [MEASURED]}, r"inputs\[0\]: must be an Input but is Output"),
            ({"start": 2.0}, "start: must be before stop, 1 s, but is 2 s; change one"),
            ({"start": "0"}, "start: must be a number but is '0'"),
            ({"stop": np.nan}, "stop: must be a finite number but is nan"),
            ({"stop": 0.5}, "outputs.y: its times must lie between start, 0 s, and stop, 0.5 s"),
            ({"start": 0.5}, "outputs.y: its times must lie between start, 0.5 s, and stop, 1 s"),
            (
                {"curve": Curve(("y",), [[0], [1]], [0, 2])},
                "curve: its times must lie between start, 0 s, and stop, 1 s, but go from 0 to 2 s",
            ),
            (
                {"bounds": [SignalBound("b", "y", [-1, 0], [0, 0], [1, 1])]},
                "bounds.b: its times must lie between start, 0 s, and stop, 1 s, but go from -1 to",
            ),
            ({"curve": T}, "curve: must be a Curve but is array"),
            (
                {"cost_function": len},
                "cost_function: must be a UserFunction but is <built-in function len>; write User",
            ),
            ({"constraint_functions": [len]}, r"constraint_functions\[0\]: must be a UserFunction"),
            ({"role": "training"}, "role: must be 'train' or 'test' but is 'training'"),
            ({"values": {"m": np.nan}}, "values.m: must be a finite number, true, false or a text"),
            ({"values": "m"}, "values: must be a dict but is 'm'; write"),
            ({"values": [("m", 1, 2)]}, r"values: must hold pairs \(name, value\)"),
            ({"values": {1: 2.0}}, r"values: must hold pairs \(name, value\) but holds \(1, 2.0\)"),
            (
                {"values": {"m": 10**400}},
                "values.m: must be a finite number, true, false or a text",
            ),
            ({"stop": 10**400}, "stop: must be a finite number of a usual size but is 1000"),
            ({"groups": 1}, "groups: must be a dict but is 1"),
            ({"outputs": [MEASURED, MEASURED]}, "outputs 'y': must appear once but appears twice"),
        ],
    )
    def test_what_contradicts_itself_is_refused(self, change, said):
        given = {"id": "a", "start": 0.0, "stop": 1.0, "inputs": [DRIVEN], "outputs": [MEASURED]}
        with pytest.raises(DataError, match=f"^experiment 'a'.{said}"):
            Experiment(**given | change)

    @pytest.mark.parametrize("id_", [1, "", None])
    def test_its_id_is_text(self, id_):
        with pytest.raises(DataError, match=r"experiment\.id: must"):
            Experiment(id_, 0.0, 1.0, [DRIVEN], [MEASURED])


class TestCurve:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"variables": ()}, "variables: must name at least one variable but are empty"),
            ({"variables": "x"}, "variables: must be a list of text but is one alone"),
            ({"variables": ("x", "")}, r"variables\[1\]: must not be empty but is"),
            ({"variables": ("x",)}, "points: must have a column for each variable, 1, but have 2"),
            ({"points": [[0, 1]]}, "points: must be at least two but are 1; a curve goes"),
            ({"points": [0, 1]}, r"points: must be a table of numbers but is of shape \(2,\)"),
            ({"points": "a"}, "points: must be a table of numbers but is 'a'"),
            ({"points": [[0, 1], [0, np.nan]]}, "points of 'v', index 1: must be a finite number"),
            ({"times": [1, 0]}, "times, index 1: times must increase but 0 goes back from 1"),
            ({"times": [0, np.inf]}, "times, index 1: the time must be a finite number but is inf"),
            ({"times": []}, "times: must have at least one time but has none"),
            ({"tolerances": (1.0,)}, "tolerances: must be as many as the variables, 2, but are 1"),
            ({"tolerances": (1, -1)}, "tolerances of 'v': must be at least 0 but is -1"),
            ({"tolerances": (np.nan, 1)}, "tolerances of 'x': must be a finite number but is nan"),
            ({"tolerances": 0.1}, "tolerances: must be a list of numbers but is a number alone"),
        ],
    )
    def test_what_is_no_curve_is_refused(self, change, said):
        given = {"variables": ("x", "v"), "points": [[0, 1], [1, 2], [0, 3]], "times": T}
        with pytest.raises(DataError, match=f"^curve.{said}"):
            Curve(**given | change)

    def test_lists_make_a_curve_whose_samples_may_be_fewer_than_its_points(self):
        curve = Curve(["x"], [[0], [1], [0]], [0, 1], [2])
        assert (curve.variables, curve.tolerances) == (("x",), (2.0,))
        assert curve.points.tolist() == [[0.0], [1.0], [0.0]]
        assert curve.names == ("tolerance of x",)

    def test_its_arrays_are_its_own(self):
        points = np.zeros((3, 1))
        curve = Curve(("x",), points, T)
        points[0] = 1.0
        assert curve.points[0] == 0.0
        assert not curve.points.flags.writeable
        assert not curve.times.flags.writeable


class TestSignalBound:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"variable": 1}, "variable: must be text but is 1"),
            ({"times": [1, 0]}, "times, index 1: times must increase but 0 goes back from 1"),
            ({"times": [1, 1]}, "times, index 1: times must increase but 1 repeats 1"),
            ({"times": []}, "times: must have at least one time but has none"),
            ({"times": [0]}, "lower: must have as many rows as the time, 1, but has 2"),
            ({"upper": [2, 2, 2]}, "upper: must have as many rows as the time, 2, but has 3"),
            ({"lower": [0, 3]}, "lower, index 1: must not be above upper but they are 3 and 2"),
            ({"lower": [0, np.nan]}, "lower, index 1: must be a finite number, or -inf where"),
            ({"upper": [-np.inf, 0]}, "upper, index 0: must be a finite number, or inf where"),
            ({"lower": 0.0}, "lower: must be a list of numbers but is a number alone"),
            ({"upper": "high"}, "upper: must be a list of numbers but is 'high'"),
            ({"upper": ["a", "b"]}, "upper: must hold numbers but holds <U1"),
            ({"scale": 0}, "scale: must be greater than 0 but is 0"),
            ({"scale": "a"}, "scale: must be a number but is 'a'"),
            ({"equality": "no"}, "equality: must be true or false but is 'no'"),
            ({"equality": True}, "lower, index 0: must be upper, because it is an equality, but"),
            (
                {"lower": [0, -np.inf], "equality": True},
                "lower, index 1: must be a finite number but is -inf",
            ),
        ],
    )
    def test_what_is_no_bound_is_refused(self, change, said):
        given = {"name": "b", "variable": "y", "times": [0, 1], "lower": [0, 1], "upper": [2, 2]}
        with pytest.raises(DataError, match=f"^bound 'b'.{said}"):
            SignalBound(**given | change)

    def test_it_has_a_name(self):
        with pytest.raises(DataError, match=r"bound\.name: must not be empty"):
            SignalBound("", "y", T, T, T)

    def test_its_arrays_are_its_own(self):
        lower = np.zeros(5)
        bound = SignalBound("b", "y", T, lower, [np.inf] * 5)
        lower[0] = 1.0
        assert bound.lower[0] == 0.0
        kept = (bound.times, bound.lower, bound.upper)
        assert not any(each.flags.writeable for each in kept)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"module": len}, "function.module: must be text but is <built-in function len>"),
        ({"name": ""}, "function.name: must not be empty"),
        ({"source": None}, "function 'f'.source: must be text but is None"),
        ({"equality": 1}, "function 'f'.equality: must be true or false but is 1"),
    ],
)
def test_what_is_no_function_is_refused(change, said):
    with pytest.raises(DataError, match=f"^{said}"):
        UserFunction(**{"module": "m", "name": "f"} | change)


class TestModel:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"interface": "modelexchange"}, "interface: must be 'model_exchange' or 'co_sim"),
            ({"archive": "a.fmu"}, r"archive: must be the bytes .* use cluster_est.read_model\("),
            ({"archive": Path("a.fmu")}, "archive: must be the bytes of an FMU but is the path"),
            ({"archive": 3}, "archive: must be a bytes but is 3"),
            ({"solver": "cvode"}, r"must be a Solver but is 'cvode'; write Solver\('cvode'\)"),
            ({"solver": Solver("fmu")}, "must be dormand_prince, rk4 or cvode for model_exchange"),
            ({"parameters": "m"}, "parameters: must be a list of text but is one alone"),
            ({"parameters": [1]}, r"parameters\[0\]: must be text but is 1"),
            ({"reset": "never"}, "reset: must be 'auto', 'reset', 'instance' or 'process'"),
        ],
    )
    def test_what_cannot_be_is_refused(self, change, said):
        given = {
            "name": "a.fmu",
            "archive": b"",
            "interface": "model_exchange",
            "solver": Solver("rk4"),
            "parameters": ("m",),
        }
        with pytest.raises(ModelError, match=f"^model.*{said}"):
            Model(**given | change)

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            ({"name": "ode45"}, "solver: must be 'dormand_prince', 'rk4', 'cvode' or 'fmu' but is"),
            ({"name": "rk4", "step": 0}, "step: must be greater than 0 but is 0"),
            ({"name": "rk4", "rtol": "1e-3"}, "rtol: must be a number but is '1e-3'"),
            ({"name": "rk4", "rtol": 1.0}, "rtol: must be less than 1 but is 1"),
            ({"name": "rk4", "max_steps": 1e6}, "max_steps: must be a whole number but is 1000000"),
        ],
    )
    def test_a_solver_that_cannot_be_is_refused(self, given, said):
        with pytest.raises(ModelError, match=f"^model.{said}"):
            Solver(**given)


def test_an_effect_has_a_name_and_a_site():
    with pytest.raises(EffectError, match=r"effect\.name: must be text but is 1"):
        Effect(1, "der(v)")
    with pytest.raises(EffectError, match=r"effect 'f'\.variables: must be a list of text"):
        Effect("f", "der(v)", "linear", "x")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"form": 3}, "form: must be text but is 3"),
        ({"equation": 3}, "equation: must be text but is 3"),
        ({"reaction": None}, "reaction: must be text but is None"),
        ({"coefficients": {"a": "0"}}, "coefficients.a: must be a number but is '0'"),
    ],
)
def test_an_effect_is_made_of_texts_and_numbers(change, said):
    with pytest.raises(EffectError, match=f"^effect 'f'.{said}"):
        Effect(**{"name": "f", "site": "der(v)"} | change)
