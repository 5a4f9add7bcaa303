"""Free curves that are smooth or monotone, against estimates that are computed without the tool."""

from __future__ import annotations

import csv
import tomllib

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.integrate import solve_ivp
from support.truth.form_terms import curve

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.closed_loop.findings.config_block import effect_block
from cluster_est.config.build import build_problem
from cluster_est.config.reader import parse_config
from cluster_est.errors import ConfigError, EffectError
from cluster_est.toml import to_toml

TIMES = 0.02 * np.arange(501)
FORCE = 4.0 * np.sin(0.8 * TIMES) * np.sin(2.1 * TIMES + 0.4)
NOISE = 0.01
CHANGE = 2.0
TRUE = (-0.3, -0.4, -0.1, 0.2, 0.15, 0.3, 0.1)


def moved(spring):
    """The displacement of the mass with this force of its spring, by a solver of its own."""

    def rates(t, state):
        force = np.interp(t, TIMES, FORCE) - spring(state[0]) - 0.5 * state[1]
        return [state[1], force]

    solved = solve_ivp(rates, (0.0, TIMES[-1]), [0.0, 0.0], t_eval=TIMES, rtol=1e-9, max_step=0.02)
    return solved.y[0]


LINEAR = moved(lambda x: 10.0 * x)
"""What the FMU does with its own table."""


def config(folder, own_fmu, effect, measured, sigma=NOISE):
    noise = sigma * np.random.default_rng(4).standard_normal(len(TIMES))
    table = pa.table({"time": TIMES, "F": FORCE, "x": measured + noise})
    pacsv.write_csv(table, folder / "run.csv")
    return {
        "model": {"fmu": str(own_fmu("spring_table", 2))},
        "effects": [effect],
        "experiments": [
            {
                "id": "run",
                "data": str(folder / "run.csv"),
                "time": "time",
                "inputs": {"u": "F"},
                "outputs": {"y": "x"},
                "sigma": {"y": sigma},
            }
        ],
    }


def at_output(**keys):
    """A curve of the force at the output: the measurements are linear in its values."""
    ends = {"low": {"start": -4.0}, "high": {"start": 4.0}}
    effect = {"name": "shift", "site": "output y", "form": "table", "variables": ["u"]}
    return effect | {"bounds": [-2.0, 2.0], "parameters": ends} | keys


def characteristic(**keys):
    ends = {"low": {"start": -0.4}, "high": {"start": 0.4}}
    effect = {"name": "bent", "site": "output y", "form": "characteristic"}
    return effect | {"bounds": [-2.0, 2.0], "parameters": ends} | keys


def built(folder, tree):
    (folder / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    return ce.read_problem(folder / "config.toml")


def hats(x, low, high, values=7):
    """(samples, values): what each value of a curve adds, by its unit vector."""
    return np.array([[curve(v, low, high, tuple(row)) for v in x] for row in np.eye(values)]).T


def smoothest(basis, rest, step, change, free):
    """Values and covariance of a least-squares curve whose second differences are penalised."""
    values = basis.shape[1]
    second = np.diff(np.eye(values), 2, axis=0) / step / (change * np.sqrt(step))
    rows = np.vstack([basis / NOISE, second])[:, free]
    target = np.concatenate([rest / NOISE, np.zeros(len(second))])
    return np.linalg.lstsq(rows, target, rcond=None)[0], np.linalg.inv(rows.T @ rows)


@pytest.mark.parametrize("kind", ["table", "characteristic"])
def test_a_smooth_curve_is_that_of_penalised_least_squares(tmp_path, own_fmu, kind):
    """Whose second differences have the variance of an integrated Wiener process."""
    if kind == "table":
        effect, (low, high), argument = at_output(slope_change=CHANGE), (-4.0, 4.0), FORCE
        free, heights = np.arange(7), TRUE
    else:
        effect, (low, high), argument = characteristic(slope_change=CHANGE), (-0.4, 0.4), LINEAR
        free, heights = np.arange(1, 6), (0.0, 0.05, 0.08, 0.02, -0.03, -0.05, 0.0)
    basis = hats(argument, low, high)
    tree = config(tmp_path, own_fmu, effect, LINEAR + basis @ heights)
    measured = pacsv.read_csv(tmp_path / "run.csv")["x"].to_numpy()
    expected, covariance = smoothest(basis, measured - LINEAR, (high - low) / 6, CHANGE, free)
    result = ce.fit(built(tmp_path, tree))
    assert result.success
    found = {e.label: e for e in result.estimates}
    rows = [found[f"{effect['name']}.k{i + 1}"] for i in free]
    assert [row.value for row in rows] == pytest.approx(expected, abs=2e-5)
    errors = np.sqrt(np.diag(covariance))
    assert [row.std_error for row in rows] == pytest.approx(errors, rel=0.15)
    assert (np.abs(expected - np.array(heights)[free]) < 6.0 * errors).all()


def test_the_band_of_a_smooth_curve_is_that_of_its_values_together(tmp_path, own_fmu):
    basis = hats(FORCE, -4.0, 4.0)
    effect, heights = at_output(slope_change=0.0005), 0.05 * np.linspace(-4.0, 4.0, 7)
    tree = config(tmp_path, own_fmu, effect, LINEAR + basis @ heights)
    (shown,) = ce.fit(built(tmp_path, tree)).shapes
    free = np.arange(7)
    _, covariance = smoothest(basis, FORCE, 8.0 / 6, 0.0005, free)
    at = hats(shown.x, -4.0, 4.0)
    expected = 1.96 * np.sqrt(np.einsum("ni,ij,nj->n", at, covariance, at))
    assert 0.5 * (shown.upper - shown.lower) == pytest.approx(expected, rel=0.2)
    apart = 1.96 * np.sqrt(np.einsum("ni,i->n", at**2, np.diag(covariance)))
    assert not np.allclose(expected, apart, rtol=0.25)  # the values are not independent


def test_a_smooth_force_at_a_state_is_found_where_the_data_were(tmp_path, own_fmu):
    heights = (3.0, 1.5, 1.0, 0.0, -0.5, -1.0, -2.0)
    measured = moved(lambda x: 10.0 * x - curve(x, -0.45, 0.45, heights))
    effect = {
        "name": "extra",
        "site": "der(v)",
        "form": "table",
        "variables": ["x"],
        "slope_change": 20.0,
        "bounds": [-20.0, 20.0],
        "monotone": "decreasing",
        "parameters": {"low": {"start": -0.45}, "high": {"start": 0.45}},
    }
    tree = config(tmp_path, own_fmu, effect, measured, 0.002)
    result = ce.fit(built(tmp_path, tree))
    assert result.success
    found = {e.label: e for e in result.estimates}
    values = np.array([found[f"extra.k{i}"].value for i in range(1, 8)])
    errors = np.array([found[f"extra.k{i}"].std_error for i in range(1, 8)])
    assert np.isfinite(errors).all()
    assert (np.abs(values - heights)[1:6] < 4.0 * errors[1:6]).all()
    assert (np.diff(values) <= 1e-6).all()
    assert found["extra.low"].estimated_on == found["extra.high"].estimated_on == "known"


def test_a_monotone_curve_keeps_its_order_where_noise_asks_for_another(tmp_path, own_fmu):
    basis = hats(FORCE, -4.0, 4.0)
    tree = config(tmp_path, own_fmu, at_output(monotone="increasing"), LINEAR + basis @ TRUE)
    tree["effects"][0]["parameters"]["low"]["fixed"] = True
    tree["effects"][0]["parameters"]["high"]["fixed"] = True
    result = ce.fit(built(tmp_path, tree))
    found = {e.label: e.value for e in result.estimates}
    values = [found[f"shift.k{i}"] for i in range(1, 8)]
    assert (np.diff(values) >= -1e-6).all()
    assert values[0] == pytest.approx(values[1], abs=1e-5)  # where the truth falls
    assert -2.0 <= min(values) <= max(values) <= 2.0


def test_a_monotone_characteristic_increases_as_a_whole(tmp_path, own_fmu):
    heights = (0.0, 0.3, 0.0, 0.05, 0.0, 0.0, 0.0)  # the third falls behind the second
    basis = hats(LINEAR, -0.4, 0.4)
    tree = config(
        tmp_path, own_fmu, characteristic(monotone="increasing"), LINEAR + basis @ heights
    )
    for end in tree["effects"][0]["parameters"].values():
        end["fixed"] = True
    found = {e.label: e.value for e in ce.fit(built(tmp_path, tree)).estimates}
    values = np.array([0.0, *(found[f"bent.k{i}"] for i in range(2, 7)), 0.0])
    whole = values + np.linspace(-0.4, 0.4, 7)
    assert (np.diff(whole) >= -1e-6).all()
    assert whole[1] == pytest.approx(whole[2], abs=1e-4)
    assert (np.diff(values) < 0.0).any()  # the curve alone may fall


def test_python_makes_the_same_parameters_and_constraints(tmp_path, own_fmu):
    tree = config(tmp_path, own_fmu, at_output(slope_change=CHANGE, monotone="increasing"), LINEAR)
    declared = built(tmp_path, tree)
    plain = built(tmp_path, {k: v for k, v in tree.items() if k != "effects"} | {
        "parameters": {"f1": {"start": -10.0, "fixed": True}}})  # fmt: skip
    made = ce.add_effect(
        plain, "output y", "table", variables=["u"], name="shift",
        start={"low": -4.0, "high": 4.0}, slope_change=CHANGE, monotone="increasing",
        bounds=(-2.0, 2.0),
    )  # fmt: skip
    assert made.parameters[1:] == declared.parameters
    assert [c.name for c in made.constraints] == [c.name for c in declared.constraints]
    assert made.effects == declared.effects


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"slope_change": 0.0}, "effect.slope_change: must be greater than 0"),
        ({"monotone": "up"}, "effect.monotone: must be"),
        ({"bounds": (1.0,)}, "effect.bounds: must be two numbers (lower, upper) but is"),
    ],
)
def test_what_python_gives_is_checked(tmp_path, own_fmu, keys, sentence):
    problem = built(tmp_path, config(tmp_path, own_fmu, at_output(), LINEAR))
    with pytest.raises(EffectError) as raised:
        ce.add_effect(problem, "output y", "table", variables=["u"], name="other", **keys)
    assert sentence in str(raised.value)


BLOCK = {
    "site": "der(v)",
    "form": "table",
    "slope_change": 1.0,
    "bounds": [-9.0, 9.0],
    "parameters": {"low": {"start": -1.0}, "high": {"start": 1.0}},
}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"form": "coulomb", "parameters": {"width": {"start": 0.1}}},
         "effects.extra.slope_change: must go with a free curve, which is a form like table"),
        ({"bounds": [2.0, 1.0]}, "effects.extra.bounds: must be [lower, upper]"),
        ({"bounds": [1.0, 2.0]}, "effects.extra.start: must lie within the bounds"),
        ({"slope_change": -1.0}, "slope_change: must be greater than 0"),
        ({"monotone": "up"}, "monotone: must be '', 'increasing' or 'decreasing'"),
        ({"name": "my extra"}, "effects.my extra: must have a name of letters, digits and _"),
        ({"name": "if"}, "effects.if: must have a name of letters, digits and _"),
        ({"parameters": {"low": {"start": 1.0}, "high": {"start": 0.0}}},
         "effects.extra.parameters.low.start: must be below that of high, 0, but is 1"),
        ({"parameters": {**BLOCK["parameters"], "k2": {"fixed": True}}},
         "effects.extra.parameters.k2.fixed: must be left out where there is slope_change"),
        ({"parameters": {**BLOCK["parameters"], "k2": {"per": "experiment"}}},
         "effects.extra.parameters.k2.per: must be left out where there is slope_change"),
        ({"parameters": {"low": {"start": -1.0, "per": "experiment"}, "high": {"start": 1.0}}},
         "effects.extra.parameters.low.per: must be left out where there is slope_change"),
        ({"site": "output y", "form": "characteristic", "monotone": "decreasing"},
         'effects.extra.monotone: must be "increasing"'),
    ],
)  # fmt: skip
def test_a_curve_that_contradicts_itself_is_refused_in_a_sentence(
    tmp_path, own_fmu, change, sentence
):
    tree = config(tmp_path, own_fmu, {"name": "extra"} | BLOCK | change, LINEAR)
    with pytest.raises(ConfigError) as raised:
        build_problem(parse_config(tree, "c.toml"), tmp_path)
    assert sentence in str(raised.value)


def test_smoothness_needs_finite_bounds(tmp_path, own_fmu):
    block = {key: value for key, value in BLOCK.items() if key != "bounds"}
    tree = config(tmp_path, own_fmu, {"name": "extra"} | block, LINEAR)
    with pytest.raises(ConfigError, match=r"extra\.bounds: must be finite where slope_change"):
        build_problem(parse_config(tree, "c.toml"), tmp_path)


def test_a_block_of_the_loop_takes_the_keys(tmp_path, own_fmu):
    """What a closed loop writes of a free curve is read with a line more."""
    free = config(tmp_path, own_fmu, at_output(), LINEAR)
    free["effects"][0]["parameters"] |= {"k2": {"start": 0.2}}
    problem = built(tmp_path, free)
    (block,) = tomllib.loads(effect_block(problem.effects[0], problem.parameters))["effects"]
    for coefficient in block["parameters"].values():
        coefficient.pop("bounds", None)  # those of the search; a loop has none for a curve
    smooth = build_problem(
        parse_config(
            free | {"effects": [block | {"slope_change": CHANGE, "bounds": [-2, 2]}]}, "c"
        ),
        tmp_path,
    )
    starts = {p.name: p.start for p in smooth.parameters}
    assert starts["shift.k2"] == 0.2
    assert starts["shift.slope"] == pytest.approx(0.2 / (8.0 / 6))


def test_what_is_exported_reads_back_as_starts(tmp_path, own_fmu, capsys):
    basis = hats(FORCE, -4.0, 4.0)
    tree = config(tmp_path, own_fmu, at_output(slope_change=CHANGE), LINEAR + basis @ TRUE)
    (tmp_path / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    run = tmp_path / "run"
    assert main(["fit", str(tmp_path / "config.toml"), "--out", str(run), "--no-report"]) == 0
    for name in ("found.csv", "found.ssv"):
        option = f"--{name[-3:]}"
        assert main(["export", str(run), option, str(tmp_path / name)]) == 0
        again = built(tmp_path, {"value_files": [name]} | tree)
        space_start = {p.name: p.start for p in again.parameters if p.name.startswith("shift.k")}
        with (tmp_path / "found.csv").open(encoding="utf-8") as file:
            exported = {row["name"]: float(row["value"]) for row in csv.DictReader(file)}
        assert space_start == {k: v for k, v in exported.items() if k in space_start}
        values = ce.fit(again, method=ce.LeastSquares(max_iterations=1)).estimates
        starts = {e.label: e.start for e in values}
        assert starts["shift.level"] == pytest.approx(exported["shift.k1"])
    assert "shift.bend_2" in capsys.readouterr().out
