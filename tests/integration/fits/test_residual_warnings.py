from dataclasses import replace

import numpy as np
import pytest
from support.problems.seen_springs import with_outputs
from support.problems.springs import spring_problem
from support.run_folders import facts
from support.truth.springs_with_friction import NOISE, write_config

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.problem.costs import COSTS
from cluster_est.problem.formulas import Formula, ParameterConstraint

HEADER = "95 % interval (too narrow)"


def declared(problem: ce.Problem, sigma: float) -> ce.Problem:
    """The same problem with a sigma."""
    return with_outputs(problem, lambda output: replace(output, sigma=sigma))


@pytest.fixture(scope="module")
def lacking(tmp_path_factory) -> ce.Problem:
    """Two springs with friction that the model lacks, and the true sigma."""
    return declared(ce.read_problem(write_config(tmp_path_factory.mktemp("springs"))), NOISE)


@pytest.fixture(scope="module")
def result(lacking) -> ce.Result:
    return ce.fit(lacking)


@pytest.fixture(scope="module")
def clean() -> ce.Problem:
    return spring_problem(experiments=3, samples=150, noise=0.002, seed=4).problem


def test_a_missing_effect_is_warned_of(result):
    assert result.diagnostics is not None
    (output,) = result.diagnostics.outputs
    assert output.structure == "something is missing"
    rows = [e for e in result.errors if e.role == "train"]
    rms = np.sqrt(np.mean([e.normalised_after**2 for e in rows]))
    assert output.rms_over_sigma == pytest.approx(rms, rel=0.02)
    (note,) = [each for each in result.notes if "x sigma" in each]
    assert "something is missing from the model" in note
    assert "close_loop(problem)" in note
    assert "to (too narrow)" in str(result)
    assert "to (too narrow)" in result._repr_html_()


@pytest.mark.parametrize("sigma", [0.002, 1.0])
def test_white_noise_gives_no_warning(clean, sigma):
    found = ce.fit(declared(clean, sigma))
    assert found.diagnostics is not None
    assert found.diagnostics.outputs[0].declared == (sigma != 1.0)
    assert found.diagnostics.findings == ()
    assert found.notes == ()
    assert "too narrow" not in str(found)


@pytest.mark.parametrize(
    ("sigma", "doubt"), [(0.0002, "sigma too small"), (0.02, "sigma too large")]
)
def test_a_wrong_sigma_is_named(clean, sigma, doubt):
    found = ce.fit(declared(clean, sigma))
    assert found.diagnostics is not None
    assert [o.sigma for o in found.diagnostics.findings] == [doubt]
    assert not found.diagnostics.too_narrow
    (note,) = found.notes
    assert f"sigma is probably 10 times {doubt.removeprefix('sigma ')}" in note.replace("9.9", "10")


def test_a_guessed_sigma_is_no_claim(clean):
    """A fit to white noise with a guess that is ten times too small or too large."""
    for sigma in (0.0002, 0.02):
        guessed = with_outputs(
            declared(clean, sigma), lambda output: replace(output, sigma_known=False)
        )
        found = ce.fit(guessed)
        assert found.diagnostics is not None
        assert not found.diagnostics.outputs[0].declared
        assert found.notes == ()


@pytest.mark.parametrize("known", [True, False])
def test_a_sigma_known_in_one_experiment_does_not_make_a_guess_known(clean, known):
    """The guess of the second experiment is ten times too small."""
    one, other = declared(clean, 0.002).experiments[0], declared(clean, 0.0002).experiments[0]
    outputs = tuple(replace(each, sigma_known=known) for each in other.outputs)
    both = (one, replace(other, id="other", outputs=outputs))
    found = ce.fit(replace(clean, experiments=both))
    assert found.diagnostics is not None
    assert found.diagnostics.outputs[0].declared == known
    mixed = [note for note in found.notes if "is known in experiment" in note]
    assert len(mixed) == (not known)
    assert known or f"experiment {one.id}, but in experiment other it is missing" in mixed[0]


@pytest.mark.slow
def test_where_residuals_have_no_such_meaning_nothing_is_said(lacking):
    names = tuple(p.name for p in lacking.parameters)
    below = ParameterConstraint("m below 5", Formula("m - 5", names, "constraints"))
    for changed in ({"cost": COSTS["huber"]()}, {"constraints": (below,)}):
        found = ce.fit(replace(lacking, **changed))
        assert found.diagnostics is None
        assert found.facts()["residuals"] is None


def test_command_run_json_and_report_say_it(tmp_path, capsys):
    config = write_config(tmp_path)
    assert main(["fit", str(config), "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out
    said = facts(tmp_path / "run")
    assert said["residuals"]["too_narrow"] is True
    (sentence,) = said["residuals"]["sentences"]
    assert "no sigma is declared" in sentence
    assert "use cluster-est close-loop" in sentence
    assert sentence in said["notes"]
    assert f"note: {sentence}" in printed
    assert HEADER in printed
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Its intervals are too narrow" in page
    assert HEADER in page
    assert "error is " in page
