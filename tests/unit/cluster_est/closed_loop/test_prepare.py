"""What a closed loop refuses, and what it sets up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_bench, made_problem
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, opened

from cluster_est.closed_loop.loop import close_loop
from cluster_est.closed_loop.prepare import _short_notes, _weight_note, _weighted
from cluster_est.closed_loop.settings import LoopSettings
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


@pytest.mark.parametrize("samples", [3, 7])
def test_too_few_measurements(samples):
    runs = [
        replace(e, outputs=(replace(e.outputs[0], times=e.outputs[0].times[:samples],
                                    values=e.outputs[0].values[:samples]),))
        for e in SPRING.experiments
    ]  # fmt: skip
    sentence = f"at least 16 measured values .* 3 parameters but have {2 * samples}"
    with (
        pytest.raises(ProblemError, match=sentence),
        opened(replace(SPRING, experiments=tuple(runs))),
    ):
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


@pytest.mark.parametrize("silent", [0.0, np.nan])
def test_an_output_without_known_noise_is_not_said_to_be_weighted_with_it(silent):
    noise = {"y0": 0.3, "y1": silent}
    note = _weight_note(_weighted(made_problem(20, outputs=2), noise), noise)
    assert "with its estimated noise, but for y1, of which no noise is known; write" in note
    assert "sigma = { y0 = 0.3, y1 = 1 }" in note


@pytest.mark.parametrize(
    ("lengths", "sigma", "said"),
    [((9, 9, 9), 1.0, True), ((9, 10, 9), 1.0, False), ((9, 9, 9), 0.1, False)],
)
def test_records_too_short_to_know_their_noise_are_named(lengths, sigma, said):
    """`estimate_noise` then takes the whole residual of the declared model."""
    notes = _short_notes(made_bench(made_problem(*lengths, outputs=2, sigma=sigma)))
    assert any("no record of y0, y1 has 10 samples" in note for note in notes) is said
    assert bool(notes) is said


def test_given_sigmas_are_kept():
    with opened(two_units(0.5)) as bench:
        assert {o.sigma for run in bench.problem.experiments for o in run.outputs} == {0.5}
        assert not any("sigma" in note for note in bench.notes)
