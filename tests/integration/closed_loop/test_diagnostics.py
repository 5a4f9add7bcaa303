"""The parts of a closed loop from Python, on a spring whose dry friction the model lacks."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.spoiled import XML, spoiled_fmu
from support.truth.springs_with_friction import FRICTION, write_config
from support.truth.systems_with_missing_effects import opened

import cluster_est as ce
from cluster_est.errors import ProblemError

SETTINGS = ce.LoopSettings(
    forms=("coulomb", "cubic", "constant"), sites=("der(v)",), draws=400, max_effects=1, pairs=False
)

TUNABLE_MASS = re.compile(rb'(name="m"[^>]*variability=")tunable')


def read(folder, **options):
    config = write_config(folder, **options)
    return ce.build_problem(ce.read_config(config), folder)


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return read(tmp_path_factory.mktemp("parts"))


@pytest.fixture(scope="module")
def seen(problem):
    return ce.detect(problem, settings=SETTINGS)


def test_detect_sees_that_something_is_missing(seen):
    assert seen.missing
    assert max(seen.p, seen.p_white, seen.p_structure) <= 0.01
    assert seen.rms["y"] > 3.0 * seen.noise["y"]
    assert "the model lacks something" in seen.sentence


@pytest.mark.parametrize(
    ("p", "p_white", "p_structure", "candidates", "said"),
    [
        (1e-5, 1e-5, 0.001, 40, "the model lacks something (p = 1e-05 among 40 candidates)"),
        (0.0, 0.0, 0.001, 1, "the model lacks something (p < 1e-300 among 1 candidate)"),
        (
            1e-5,
            0.3,
            0.001,
            40,
            "the residual is autocorrelated, and no candidate explains it (p = 0.3)",
        ),
        (0.3, 0.3, 0.001, 40, "the residual has smooth structure (p = 0.001)"),
        (0.3, 0.3, 0.5, 40, "no missing effect is visible in the data (p = 0.3)"),
        (1.0, 1.0, 0.5, 0, "the residual looks like noise (p = 0.5), but no candidate was"),
        (1.0, 1.0, 0.001, 0, "has smooth structure (p = 0.001), but no candidate was compared"),
    ],
)
def test_what_a_detection_says(seen, p, p_white, p_structure, candidates, said):
    values = {"p": p, "p_white": p_white, "p_structure": p_structure, "candidates": candidates}
    assert said in replace(seen, **values).sentence
    hidden = replace(seen, **values, numerical_error="the step is too long")
    assert not hidden.missing
    assert hidden.sentence == "the step is too long"


def test_detect_sees_nothing_in_noise(tmp_path):
    seen = ce.detect(read(tmp_path, friction=0.0), settings=SETTINGS)
    assert not seen.missing
    assert seen.rms["y"] == pytest.approx(1e-3, rel=0.2)
    assert "no missing effect" in seen.sentence


def test_locate_ranks_the_candidates(problem):
    first, second, *rest = ce.locate(problem, settings=SETTINGS)
    assert {(f.form, f.variables) for f in (first, second)} == {
        ("coulomb", ("v",)),
        ("cubic", ("v",)),
    }
    assert first.log_p <= second.log_p < min(f.log_p for f in rest)
    assert {f.form for f in rest} == {"cubic", "constant"}
    assert first.confounded_with == ""


def test_what_a_parameter_does_as_well_is_set_aside(problem):
    """A force in proportion to the speed is what the damper's parameter says already."""
    (found,) = ce.locate(problem, settings=SETTINGS.changed(forms=("viscous",)))
    assert (found.stage, found.confounded_with) == ("set aside", "c")
    assert found.distinct < 1e-3


def test_an_effect_that_was_added_is_fitted(problem):
    grown = ce.add_effect(problem, "der(v)", "coulomb", name="friction")
    strength, width = grown.parameters[-2:]
    assert (strength.name, strength.start, strength.fixed) == ("friction.k", 0.0, False)
    assert (width.name, width.fixed) == ("friction.width", True)
    assert 0.0 < width.start < 0.1
    assert ce.fit(grown).x["friction.k"] == pytest.approx(FRICTION, rel=0.05)
    assert not ce.detect(grown, settings=SETTINGS).missing


def test_an_effect_starts_where_it_is_told(problem):
    grown = ce.add_effect(problem, "der(v)", "coulomb", start={"k": 0.2, "width": 0.02})
    assert [(p.name, p.start, p.fixed) for p in grown.parameters[-2:]] == [
        ("coulomb.k", 0.2, False),
        ("coulomb.width", 0.02, False),
    ]
    own = ce.add_effect(problem, "der(v)", equation="-a * v^3", name="own", start={"a": 0.5})
    assert (own.parameters[-1].name, own.parameters[-1].start) == ("own.a", 0.5)


@pytest.mark.parametrize(
    ("given", "phrase"),
    [
        ({"site": "der(v)", "form": "colomb"}, "did you mean 'coulomb'?"),
        ({"site": "der(w)", "form": "coulomb"}, "has no site der(w)"),
        ({"site": "der(v)", "form": "sine"}, "parameters.f.start is missing"),
        ({"site": "der(v)"}, "must have exactly one of form and equation, but has neither"),
        ({"site": "der(v)", "form": "coulomb", "start": {"q": 1.0}}, "no such coefficient"),
        ({"site": "der(v)", "equation": "a *", "name": "own", "start": {"a": 1.0}}, "equation"),
    ],
)
def test_a_wrong_effect_is_a_sentence(problem, given, phrase):
    with pytest.raises(ce.ClusterEstError) as caught:
        ce.add_effect(problem, **given)
    assert phrase in str(caught.value)


def test_outputs_without_sigma_are_weighted_and_the_reader_is_told(problem):
    runs = []
    for run in problem.experiments:
        (y,) = run.outputs
        speed = ce.Output("v", y.times, 1e3 * np.gradient(y.values, y.times), 1.0)
        runs.append(replace(run, outputs=(y, speed)))
    both = replace(problem, experiments=tuple(runs))
    with opened(both, SETTINGS) as bench:
        (note,) = bench.scope.notes
        sigmas = {o.variable: o.sigma for o in bench.fitter.problem.experiments[0].outputs}
    assert sigmas["y"] < 0.01 < sigmas["v"]
    assert f"sigma = {{ y = {sigmas['y']:.6g}, v = {sigmas['v']:.6g} }}" in note


@pytest.fixture(scope="module")
def fixed_mass(problem):
    """A problem whose FMU does not allow its mass to change while it runs."""

    def change(entries):
        entries[XML], count = TUNABLE_MASS.subn(rb"\1fixed", entries[XML])
        assert count == 1

    return replace(problem, model=replace(problem.model, archive=spoiled_fmu(change)))


def test_a_parameter_that_the_fmu_declares_fixed_is_said_to_be_closed(problem, fixed_mass):
    with opened(fixed_mass, SETTINGS) as workbench:
        (note,) = (n for n in workbench.scope.notes if n.startswith("no effect can act"))
        assert "no effect can act on the parameter m, because" in note
        assert "parameter m" not in workbench.scope.sites
        assert "parameter c" in workbench.scope.sites
    with opened(problem, SETTINGS) as workbench:
        assert not any("no effect can act" in note for note in workbench.scope.notes)


def test_a_closed_site_that_was_asked_for_is_refused_with_the_cause(fixed_mass):
    with pytest.raises(ProblemError, match=r"'parameter m' cannot be used, because .* tunable"):
        ce.detect(fixed_mass, settings=SETTINGS.changed(sites=("parameter m",)))
