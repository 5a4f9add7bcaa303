"""What a closed loop refuses, and what it sets up."""

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, opened

from cluster_est import LoopSettings, close_loop
from cluster_est.errors import ProblemError

SPRING = missing_effect_problem("mass_spring_damper")


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"forms": ("coulom",)}, r"closed_loop\.effects: there is no form 'coulom'.*coulomb"),
        ({"sites": ("der(w)",)}, r"does not offer the site 'der\(w\)'; did you mean 'der\("),
        ({"sites": ("input y",)}, r"closed_loop\.sites: mass_spring_damper\.fmu does not offer"),
        (
            {"forms": ("backlash",), "sites": ("output y",)},
            r"closed_loop\.effects: must name a form for one of the sites",
        ),
    ],
)
def test_forms_and_sites_that_are_not_there(settings, sentence):
    with pytest.raises(ProblemError, match=sentence), opened(SPRING, LoopSettings(**settings)):
        pass


def test_a_search_without_a_candidate_says_so():
    settings = LoopSettings(forms=("coulomb",), sites=("output y",))
    result = close_loop(SPRING, settings=settings)
    assert not result.effects
    assert result.notes[0].startswith(
        "no effect was tried: none of the forms coulomb makes sense on these data at output y"
    )


def test_states_are_closed_in_co_simulation():
    problem = missing_effect_problem("mass_spring_damper", interface="co_simulation")
    with (
        pytest.raises(ProblemError, match="does not offer"),
        opened(problem, LoopSettings(sites=("der(v)",))),
    ):
        pass
    with opened(problem) as bench:
        assert "der(v)" not in bench.sites
        assert any("state derivatives were closed" in note for note in bench.notes)


def shortened(*samples, sigma=0.5):
    """Springs of which only so many measurements are left, the first ones."""
    runs = []
    for run, count in zip(SPRING.experiments, samples, strict=True):
        (output,) = run.outputs
        kept = {"times": output.times[:count], "values": output.values[:count], "sigma": sigma}
        runs.append(replace(run, outputs=(replace(output, **kept),)))
    return replace(SPRING, experiments=tuple(runs))


@pytest.mark.parametrize("samples", [3, 7])
def test_too_few_measurements(samples):
    sentence = f"at least 16 measured values .* 3 parameters but have {2 * samples}"
    with pytest.raises(ProblemError, match=sentence), opened(shortened(samples, samples)):
        pass


def test_notes_for_a_reader():
    with opened(missing_effect_problem("mass_spring_damper", experiments=1)) as bench:
        assert any("only one training experiment" in note for note in bench.notes)
        assert any('no experiment has role = "test"' in note for note in bench.notes)
    first, second = SPRING.experiments
    with opened(replace(SPRING, experiments=(first, replace(second, role="test")))) as bench:
        assert bench.train == (0,)
        assert not any("role" in note for note in bench.notes)


def two_units(sigma):
    """Two speeds, one with ten times the noise."""
    problem = measured(missing_effect_problem("two_mass_drive"), 0.0)
    generator = np.random.default_rng(8)
    noisy = []
    for run in problem.experiments:
        outputs = [
            replace(o, sigma=sigma, values=o.values + noise * generator.normal(size=len(o.values)))
            for o, noise in zip(run.outputs, (0.02, 0.2), strict=True)
        ]
        noisy.append(replace(run, outputs=tuple(outputs)))
    return replace(problem, experiments=tuple(noisy))


def test_outputs_without_sigma_are_weighted_with_their_noise():
    with opened(two_units(1.0)) as bench:
        for run in bench.problem.experiments:
            assert [o.sigma for o in run.outputs] == pytest.approx([0.02, 0.2], rel=0.2)
        assert any("sigma = { motor_speed = 0.0" in note for note in bench.notes)


def test_an_output_without_known_noise_is_not_said_to_be_weighted_with_it():
    """Nothing was measured of one of them."""
    problem = two_units(1.0)
    runs = []
    for run in problem.experiments:
        motor, load = run.outputs
        nothing = replace(load, times=np.zeros(0), values=np.zeros(0))
        runs.append(replace(run, outputs=(motor, nothing)))
    with opened(replace(problem, experiments=tuple(runs))) as bench:
        (note,) = (note for note in bench.notes if "sigma" in note)
    assert "noise, but for load_speed, of which no noise is known; write" in note
    assert "load_speed = 1 }" in note


@pytest.mark.parametrize(
    ("samples", "sigma", "said"), [((9, 9), 1.0, True), ((9, 10), 1.0, False), ((9, 9), 0.1, False)]
)
def test_records_too_short_to_know_their_noise_are_named(samples, sigma, said):
    """The whole residual of the declared model is taken for noise then."""
    with opened(shortened(*samples, sigma=sigma)) as bench:
        notes = [note for note in bench.notes if "no record of y has 10 samples" in note]
    assert bool(notes) is said


def test_given_sigmas_are_kept():
    with opened(two_units(0.5)) as bench:
        assert {o.sigma for run in bench.problem.experiments for o in run.outputs} == {0.5}
        assert not any("sigma" in note for note in bench.notes)
