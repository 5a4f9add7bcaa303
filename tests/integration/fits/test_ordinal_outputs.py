import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kendalltau
from support.problems.seen_springs import (
    MASS_IS_KNOWN,
    example_without_outputs,
    seen_springs,
    values_of,
    with_outputs,
)
from support.problems.springs import ROOT, TRUE, spring_problem
from support.run_folders import rows

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS
from cluster_est.problem.sensors import shared_sensor


def judged(grades=0, noise=0.0):
    """Springs of which somebody says in how many grades the position is; 0 for its rank alone."""
    generator = np.random.default_rng(0)

    def see(output, number):
        seen = output.values + noise * generator.normal(size=len(output.times))
        if grades:
            seen = np.digitize(seen, np.quantile(seen, np.linspace(0, 1, grades + 1)[1:-1]))
        return replace(output, values=seen.astype(float), ordinal=True)

    return seen_springs(see)


@pytest.fixture(scope="module")
def ranked():
    return ce.fit(judged())


def test_ranks_alone_say_what_the_parameters_are(ranked):
    assert ranked.success
    assert ranked.x["k"] == pytest.approx(TRUE["k"], rel=1e-3)
    assert ranked.x["c"] == pytest.approx(TRUE["c"], rel=5e-3)


def test_monotone_functions_of_the_values_say_the_same(ranked):
    bent = with_outputs(judged(), lambda o: replace(o, values=np.exp(9.0 * o.values)))
    assert ce.fit(bent).x == ranked.x


@pytest.mark.parametrize(
    ("grades", "differences", "within"), [(3, "central", 0.15), (10, "sensitivities", 0.05)]
)
def test_few_grades_say_less(grades, differences, within):
    found = ce.fit(judged(grades), ce.LeastSquares(differences=differences)).x
    assert found["k"] == pytest.approx(TRUE["k"], rel=0.01)
    assert found["c"] == pytest.approx(TRUE["c"], rel=within)


@pytest.mark.slow
def test_what_an_order_says_nothing_of_is_named():
    """A sensor's scale changes no order; a known start in metres says how large the rest is."""
    problem = judged()
    sensor = shared_sensor("y")
    (scale,) = sensor.parameters
    given = (*problem.parameters, replace(scale, bounds=(0.1, 10.0), start=2.0))
    found = ce.fit(replace(problem, parameters=given, effects=(sensor.effect,)))
    assert "sensor_y.scale has no effect on any residual" in found.notes
    free = tuple(replace(p, fixed=False) for p in problem.parameters)
    found = ce.fit(replace(problem, parameters=free))
    assert found.x["m"] == pytest.approx(TRUE["m"], rel=2e-3)


def test_there_are_no_intervals_and_no_tests_of_the_residuals(ranked):
    assert all(np.isnan(each.std_error) for each in ranked.estimates if each.label in ("k", "c"))
    assert ranked.diagnostics is None
    assert any("there are no intervals, because for an ordinal output" in n for n in ranked.notes)


def test_the_note_counts_the_pairs_in_order():
    result = ce.fit(judged(4, noise=0.02))
    agreeing = there = 0.0
    for one in result.simulations:
        (output,) = result.problem.experiments[one.experiment].outputs
        values = one.outcome.trajectory.at("y", output.times)
        unequal = sum(
            int(np.sum(output.values == a) * np.sum(output.values == b))
            for a in range(4)
            for b in range(a)
        )
        # tau-c is 2 (in order - not in order) / n^2 / (1 - 1 / K), with no ties in the simulation
        tau = kendalltau(output.values, values, variant="c").statistic
        excess = tau * len(values) ** 2 * (1.0 - 1.0 / 4.0) / 2.0
        there, agreeing = there + unequal, agreeing + (unequal + excess) / 2.0
    (note,) = [n for n in result.notes if "only the order of the values of y is compared" in n]
    assert f"{agreeing / there:.3%} are simulated in the right order" in note


def test_the_tables_hold_categories_and_what_is_nearest_in_them():
    result = ce.fit(judged(3, noise=0.02))
    rows = [row for row in result.table("categories").to_pylist() if row["experiment"] == "e1"]
    assert [row["category"] for row in rows] == [0.0, 1.0, 2.0]
    assert [row["samples"] for row in rows] == [50, 50, 50]
    assert rows[0]["lower"] == -np.inf
    assert rows[0]["upper"] < rows[1]["lower"] < rows[1]["upper"] < rows[2]["lower"]
    table = result.table("residuals").to_pylist()
    own = [row for row in table if row["experiment"] == "e1"]
    spread = np.std([row["simulated"] for row in own])
    for row in own:
        distance = (row["measured"] - row["simulated"]) / spread
        assert distance == pytest.approx(row["residual"], abs=1e-12)
    (error,) = [e for e in result.errors if e.experiment == "e1"]
    size = np.sqrt(np.mean([row["residual"] ** 2 for row in own]))
    assert (error.rmse_after, error.normalised_after) == pytest.approx((size, size))
    assert error.unit == ""


def test_a_held_out_part_has_the_categories_of_its_record():
    problem = judged(5)
    train, held_out = ce.Experiment.hold_out(problem.experiments[1], [(1.0, 1.5)])
    others = (problem.experiments[0], problem.experiments[2])
    result = ce.fit(replace(problem, experiments=(train, held_out, *others)))
    rows = result.table("categories").to_pylist()
    kept = ("category", "samples", "lower", "upper")
    own, of_record = (
        [[row[key] for key in kept] for row in rows if row["experiment"] == name]
        for name in (held_out.id, train.id)
    )
    for one, other in zip(own, of_record, strict=True):
        assert one == pytest.approx(other, rel=1e-6)
    assert any("of the pairs of different held-out values" in note for note in result.notes)


def test_a_sensor_that_is_read_in_numbers_counts_beside_one_that_is_not():
    problem = judged()
    exact = spring_problem(3).problem.experiments[0].outputs[0]
    first = problem.experiments[0]
    mixed = (replace(first, outputs=(replace(exact, sigma=0.001),)), *problem.experiments[1:])
    free = tuple(replace(p, fixed=False) for p in problem.parameters)
    found = ce.fit(replace(problem, parameters=free, experiments=mixed))
    assert found.x["m"] == pytest.approx(TRUE["m"], rel=1e-3)


def test_reduced_answers_give_the_same_cost():
    problem = judged(4)
    whole = ce.fit(problem, method="pattern_search", resources=ce.Resources(budget=ce.Budget(40)))
    values = {each.label: each.value for each in whole.estimates if each.label in ("k", "c")}
    found = ce.simulate(problem, values=values).values()
    (row,) = [sum(np.sum(s.outcome.residuals**2) for s in found)]
    assert whole.cost == pytest.approx(row, rel=1e-9)


def still(problem):
    (first, *rest) = problem.experiments
    output = replace(first.outputs[0], values=np.full(len(first.outputs[0].times), 2.0))
    return replace(problem, experiments=(replace(first, outputs=(output,)), *rest))


@pytest.mark.parametrize(
    ("change", "how", "said"),
    [
        (still, {}, "output y: an ordinal output must have at least two different values"),
        (lambda p: replace(p, cost=COSTS["huber"]()), {}, "so cost.name must be"),
        (None, {"uncertainty": ce.UncertaintySettings(profiles=("k",))}, "uncertainty.profiles"),
        (None, {"uncertainty": ce.UncertaintySettings(posterior=1000)}, "has an ordinal output"),
        (None, {"shooting": {"segments": 3}}, "cannot cut experiment 'e0'"),
    ],
)
def test_what_an_order_cannot_give_is_refused(change, how, said):
    problem = judged(4)
    with pytest.raises(ProblemError, match=said):
        ce.fit(problem if change is None else change(problem), **how)


@pytest.fixture
def words(tmp_path):
    """The example with positions in words, as a config beside its data."""
    data = ROOT / "configs" / "data" / "mass_spring_damper"
    for number in range(1, 6):
        header, *rows = (data / f"exp{number}.csv").read_text(encoding="utf-8").splitlines()
        place = header.split(",").index("position")
        cells = [row.split(",") for row in rows]
        for row in cells:
            value = float(row[place])
            row[place] = "low" if value < -0.02 else "high" if value > 0.02 else " medium "
        cells[3][place] = ""
        made = "\n".join([header, *(",".join(row) for row in cells)])
        (tmp_path / f"exp{number}.csv").write_text(made, encoding="utf-8")
    (tmp_path / "words.toml").write_text(example_without_outputs(data='"'), encoding="utf-8")
    return tmp_path


def outputs(ordinal, more=""):
    return f"experiment_defaults.outputs={{y={{column='position', ordinal={ordinal}{more}}}}}"


WORDS = outputs("['low', 'medium', 'high']")


def test_a_config_gives_words(words):
    config, run = str(words / "words.toml"), words / "run"
    assert main(["fit", config, "--out", str(run), WORDS, *MASS_IS_KNOWN]) == 0
    assert values_of(run)["k"] == pytest.approx(TRUE["k"], rel=0.03)
    categories = rows(run, "categories")
    assert {row["category"] for row in categories} == {1.0, 2.0, 3.0}
    assert sum(row["samples"] for row in categories if row["experiment"] == "exp1") == 499


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([outputs("['low', 'high']")], "one of the listed grades, but is 'medium'"),
        ([outputs("['low', 'low']")], "ordinal: must name each grade once.*'low'"),
        ([outputs("['low']")], "ordinal: must be .* at least two words"),
        ([outputs("3")], "ordinal: must be .* at least two words"),
        ([outputs("true")], "row 2: must be a number, but is ' medium '"),
        ([WORDS.replace("position", "place")], "has no column 'place'"),
        (
            [outputs("true", ", free_scale='shared'")],
            'free_scale: must not be "shared" for an ordinal output',
        ),
        ([WORDS, "cost.time_base=union"], "for an ordinal output"),
        ([WORDS, "cost.normalise=range"], "for an ordinal output"),
    ],
)
def test_a_mistake_in_a_config_is_met_with_a_sentence(given, said, words, capsys):
    assert main(["fit", str(words / "words.toml"), "--out", str(words / "run"), *given]) == 2
    error = capsys.readouterr().err
    assert re.search(said, error)
    assert "Traceback" not in error
