"""Free curves that are smooth or monotone, against estimates that are computed without the tool."""

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
from cluster_est.closed_loop.findings.effects import effect_block
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
    run = {"id": "run", "data": str(folder / "run.csv"), "time": "time", "sigma": {"y": sigma}}
    return {
        "model": {"fmu": str(own_fmu("spring_table", 2))},
        "effects": [effect],
        "experiments": [run | {"inputs": {"u": "F"}, "outputs": {"y": "x"}}],
    }


def ends(half, **more):
    return {"low": {"start": -half} | more, "high": {"start": half} | more}


def at_output(fixed=False, **keys):
    """A curve of the force at the output: the measurements are linear in its values."""
    effect = {"name": "shift", "site": "output y", "form": "table", "variables": ["u"]}
    return effect | {"bounds": [-2.0, 2.0], "parameters": ends(4.0, fixed=fixed)} | keys


def characteristic(fixed=False, **keys):
    effect = {"name": "bent", "site": "output y", "form": "characteristic"}
    return effect | {"bounds": [-2.0, 2.0], "parameters": ends(0.4, fixed=fixed)} | keys


def built(folder, tree):
    (folder / "config.toml").write_text(to_toml(tree), encoding="utf-8")
    return ce.read_problem(folder / "config.toml")


def fitted(folder, tree):
    """The estimates of a fit, by their labels."""
    result = ce.fit(built(folder, tree))
    assert result.success
    return {e.label: e for e in result.estimates}


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
    found = fitted(tmp_path, tree)
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
    effect = {"name": "extra", "site": "der(v)", "form": "table", "variables": ["x"]}
    effect |= {"slope_change": 20.0, "bounds": [-20.0, 20.0], "monotone": "decreasing"}
    effect |= {"parameters": ends(0.45)}
    tree = config(tmp_path, own_fmu, effect, measured, 0.002)
    found = fitted(tmp_path, tree)
    values = np.array([found[f"extra.k{i}"].value for i in range(1, 8)])
    errors = np.array([found[f"extra.k{i}"].std_error for i in range(1, 8)])
    assert np.isfinite(errors).all()
    assert (np.abs(values - heights)[1:6] < 4.0 * errors[1:6]).all()
    assert (np.diff(values) <= 1e-6).all()
    assert found["extra.low"].estimated_on == found["extra.high"].estimated_on == "known"


def test_a_monotone_curve_keeps_its_order_where_noise_asks_for_another(tmp_path, own_fmu):
    basis = hats(FORCE, -4.0, 4.0)
    effect = at_output(fixed=True, monotone="increasing")
    found = fitted(tmp_path, config(tmp_path, own_fmu, effect, LINEAR + basis @ TRUE))
    values = [found[f"shift.k{i}"].value for i in range(1, 8)]
    assert (np.diff(values) >= -1e-6).all()
    assert values[0] == pytest.approx(values[1], abs=1e-5)  # where the truth falls
    assert -2.0 <= min(values) <= max(values) <= 2.0


def test_a_monotone_characteristic_increases_as_a_whole(tmp_path, own_fmu):
    heights = (0.0, 0.3, 0.0, 0.05, 0.0, 0.0, 0.0)  # the third falls behind the second
    basis = hats(LINEAR, -0.4, 0.4)
    effect = characteristic(fixed=True, monotone="increasing")
    found = fitted(tmp_path, config(tmp_path, own_fmu, effect, LINEAR + basis @ heights))
    values = np.array([0.0, *(found[f"bent.k{i}"].value for i in range(2, 7)), 0.0])
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
    ("keys", "said"),
    [
        ({"slope_change": 0.0}, r"slope_change: must be greater than 0"),
        ({"monotone": "up"}, r"monotone: must be"),
        ({"bounds": (1.0,)}, r"bounds: must be two numbers"),
    ],
)
def test_what_python_gives_is_checked(tmp_path, own_fmu, keys, said):
    problem = built(tmp_path, config(tmp_path, own_fmu, at_output(), LINEAR))
    with pytest.raises(EffectError, match=rf"effect\.{said}"):
        ce.add_effect(problem, "output y", "table", variables=["u"], name="other", **keys)


ENDS = ends(1.0)
BLOCK = {"site": "der(v)", "form": "table", "slope_change": 1.0, "bounds": [-9.0, 9.0]}
BLOCK |= {"parameters": ENDS}
LEFT_OUT = "must not be used with slope_change"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"form": "coulomb", "parameters": {"width": {"start": 0.1}}},
            r"slope_change: is only for a form that is a free curve",
        ),
        ({"bounds": [2.0, 1.0]}, r"bounds: must be \[lower, upper\]"),
        ({"bounds": [1.0, 2.0]}, r"start: must lie within the bounds"),
        ({"bounds": [-np.inf, np.inf]}, r"bounds: must be finite with slope_change"),
        ({"slope_change": -1.0}, r"slope_change: must be greater than 0"),
        ({"monotone": "up"}, r"monotone: must be.*increasing.*decreasing"),
        (
            {"site": "output y", "form": "characteristic", "monotone": "decreasing"},
            r"monotone: must be.*increasing",
        ),
        ({"name": "if"}, r"if: the name must consist of letters, digits and _"),
        ({"name": "my extra"}, r"my extra: the name must consist of letters, digits and _"),
        (
            {"parameters": {"low": {"start": 1.0}, "high": {"start": 0.0}}},
            r"low\.start: must be below the start of high, which is 0, but is 1",
        ),
        ({"parameters": ENDS | {"k2": {"fixed": True}}}, rf"k2\.fixed: {LEFT_OUT}"),
        ({"parameters": ENDS | {"k2": {"per": "experiment"}}}, rf"k2\.per: {LEFT_OUT}"),
        (
            {"parameters": ENDS | {"low": {"start": -1.0, "per": "experiment"}}},
            rf"low\.per: {LEFT_OUT}",
        ),
    ],
)
def test_a_curve_that_contradicts_itself_is_refused_in_a_sentence(tmp_path, own_fmu, change, said):
    tree = config(tmp_path, own_fmu, {"name": "extra"} | BLOCK | change, LINEAR)
    with pytest.raises(ConfigError, match=rf"effects.*{said}"):
        built(tmp_path, tree)


def test_a_block_of_the_loop_takes_the_keys(tmp_path, own_fmu):
    """What a closed loop writes of a free curve is read with a line more."""
    free = config(tmp_path, own_fmu, at_output(), LINEAR)
    free["effects"][0]["parameters"] |= {"k2": {"start": 0.2}}
    problem = built(tmp_path, free)
    (block,) = tomllib.loads(effect_block(problem.effects[0], problem.parameters))["effects"]
    for coefficient in block["parameters"].values():
        coefficient.pop("bounds", None)  # those of the search; a loop has none for a curve
    smooth = built(
        tmp_path, free | {"effects": [block | {"slope_change": CHANGE, "bounds": [-2, 2]}]}
    )
    starts = {p.name: p.start for p in smooth.parameters}
    assert starts["shift.k2"] == 0.2
    assert starts["shift.slope"] == pytest.approx(0.2 / (8.0 / 6))


@pytest.mark.slow
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
