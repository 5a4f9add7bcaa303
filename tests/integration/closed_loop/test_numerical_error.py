"""The error of a solver is measured at a fit, and is not taken for something that is missing.

The truth of an error is another solver's solution with a tight tolerance.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_candidate
from support.problems.seen_springs import with_outputs
from support.spoiled import spoiled_fmu
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    unfitted,
)

import cluster_est as ce
from cluster_est import Resources, Solver
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.numerical_error import (
    error_with_effects,
    measure_numerical_error,
)
from cluster_est.errors import ProblemError

NOISE = 0.004
TIGHT = missing_effect_problem("mass_spring_damper", signals=())
DATA = with_outputs(measured(TIGHT, NOISE), lambda output: replace(output, sigma=NOISE))
ADDED = made_candidate("clip")
COMMUNICATION = 0.1
INTERVAL = 0.05


def coarse(problem, step):
    """The same experiments in communication steps that are too long, over which inputs are held."""
    abilities = ("canHandleVariableCommunicationStepSize", "canInterpolateInputs")
    model = replace(
        problem.model,
        archive=spoiled_fmu(xml={f'{name}="true"': f'{name}="false"' for name in abilities}),
        interface="co_simulation",
        solver=Solver("fmu", step=step),
    )
    return replace(problem, model=model)


def thinned(problem, stride):
    """Every so many samples of inputs and outputs."""

    def some(signal):
        return replace(signal, times=signal.times[::stride], values=signal.values[::stride])

    runs = tuple(
        replace(e, inputs=tuple(map(some, e.inputs)), outputs=tuple(map(some, e.outputs)))
        for e in problem.experiments
    )
    return replace(problem, experiments=runs)


def error_and_truth(problem, exact):
    """What is measured at the start values, and the difference to an exact solution."""
    with opened(exact) as bench:
        truth = unfitted(bench).residuals
    with opened(problem) as bench:
        fitted = unfitted(bench)
        found = measure_numerical_error(bench.fitter, fitted, np.ones(1), Resources())
    return found, float(np.sqrt(np.mean((fitted.residuals - truth) ** 2)))


@pytest.mark.parametrize("rtol", [1e-3, 1e-5])
def test_the_error_of_a_tolerance_shows_where_the_data_bound_the_steps(rtol):
    """Both tolerances take the same steps here, one from each sample to the next."""
    exact = thinned(DATA, 20)
    tight = replace(exact, model=replace(exact.model, solver=Solver("dormand_prince", rtol=1e-11)))
    problem = replace(exact, model=replace(exact.model, solver=Solver("dormand_prince", rtol=rtol)))
    found, truth = error_and_truth(problem, tight)
    assert truth > 0.0
    assert found.rms[0] == pytest.approx(truth, rel=0.1)


def test_the_error_of_runge_kutta_is_that_to_an_exact_solver():
    exact = thinned(DATA, 20)
    problem = replace(exact, model=replace(exact.model, solver=Solver("rk4")))
    found, truth = error_and_truth(problem, exact)
    assert found.order == pytest.approx(4.0, abs=0.3)
    assert found.rms[0] == pytest.approx(truth, rel=0.1)


def test_the_error_of_held_inputs_is_that_to_inputs_between_samples():
    found, truth = error_and_truth(coarse(DATA, INTERVAL), DATA)
    assert found.order == pytest.approx(1.0, abs=0.3)
    assert found.rms[0] == pytest.approx(truth, rel=0.2)


def test_a_communication_step_that_is_too_long_is_no_missing_effect():
    found = ce.close_loop(coarse(DATA, COMMUNICATION))
    assert found.verdict is Verdict.UNEXPLAINED
    assert found.effects == ()
    assert found.after is found.before
    assert "the communication step of 0.1 s causes an error of" in found.message
    assert "set model.step = 0.0" in found.message
    assert any("the search looked for no effects" in note for note in found.notes)


def test_its_diagnostics_say_the_same():
    problem = coarse(DATA, COMMUNICATION)
    seen = ce.detect(problem)
    assert max(seen.p, seen.p_white) <= seen.significance
    assert not seen.missing
    assert "the communication step of 0.1 s causes an error of" in seen.sentence
    assert any("the search looked for no effects" in note for note in seen.notes)
    with pytest.raises(
        ProblemError, match=r"a missing effect cannot be distinguished from this error"
    ):
        ce.locate(problem)


def clipped(problem, limit):
    """The problem with a declared effect: its input never exceeds a limit."""
    effect = ce.Effect("clip", "input F", "saturation")
    known = ce.Parameter("clip.limit", limit, fixed=True)
    return replace(problem, effects=(effect,), parameters=(*problem.parameters, known))


def limit_of(problem):
    return 0.4 * max(float(np.abs(e.inputs[0].values).max()) for e in problem.experiments)


def with_error_of_effects(problem):
    """The errors of the declared model, and with an effect."""
    with opened(problem) as bench:
        declared = unfitted(bench)
        small = measure_numerical_error(bench.fitter, declared, np.ones(1), Resources())
        assert error_with_effects(bench.fitter, declared, small, np.ones(1), Resources()) is small
    with opened(clipped(problem, limit_of(problem))) as bench:
        grown = replace(unfitted(bench), added=(ADDED,))
        return small, error_with_effects(bench.fitter, grown, small, np.ones(1), Resources())


def test_a_limit_that_is_reached_between_two_communication_points_has_an_error():
    slow = thinned(DATA, 10)
    driven = replace(slow.model, interface="co_simulation", solver=Solver("fmu"))
    small, found = with_error_of_effects(replace(slow, model=driven))
    assert found.rms[0] > 3.0 * small.rms[0]
    residuals = []
    for model in (driven, slow.model):
        with opened(clipped(replace(slow, model=model), limit_of(slow))) as bench:
            residuals.append(unfitted(bench).residuals)
    truth = float(np.sqrt(np.mean((residuals[0] - residuals[1]) ** 2)))
    assert found.rms[0] == pytest.approx(truth, rel=0.5)
    (sentence,) = replace(found, noise=found.rms).notes_with_effects
    assert sentence.startswith("in the model with effects, the communication step of")


def test_a_tolerance_keeps_the_error_of_an_effect_small():
    small, found = with_error_of_effects(thinned(DATA, 10))
    assert found is small


@pytest.fixture(scope="module")
def of_a_step():
    return error_and_truth(coarse(DATA, COMMUNICATION), DATA)[0]


def sized(found, rms, residual, order=1.0, noise=1.0):
    """An error of some size at the second of two outputs, beside its noise and residual."""
    sizes = {"rms": rms, "noise": noise, "residual": residual}
    arrays = {name: np.array([0.0, size]) for name, size in sizes.items()}
    return replace(found, outputs=("x", "y"), squares=rms**2 * 100.0, order=order, **arrays)


@pytest.mark.parametrize(
    ("rms", "residual", "noise", "hides"),
    [
        (0.4, 1.0, 1.0, False),
        (0.6, 1.2, 1.0, True),
        (4.3, 4.4, 1.0, True),
        (4.3, 100.0, 1.0, False),
        (0.6, 7.0, 1.0, False),
        (1e-9, 1e-9, 0.0, True),
        (1e-9, 1.0, 0.0, False),
        (1e-9, 0.0, 0.0, False),
    ],
)
def test_an_error_hides_effects_that_is_large_beside_noise_and_residual(
    of_a_step, rms, residual, noise, hides
):
    """Where there is no noise the residual decides."""
    assert sized(of_a_step, rms, residual, noise=noise).hides_effects is hides


def test_the_refusal_says_how_large_and_what_to_set(of_a_step):
    found = sized(of_a_step, 4.3, 4.4)
    said = "communication step of 0.1 s.*4.3 times the noise in output y, so "
    said += "a missing effect cannot be distinguished.*set model.step = 0.0007813.* first"
    assert re.search(said, found.refusal)
    assert found.notes[0].startswith("the search looked for no effects, because the commun")
    assert "1 times the remaining residual" in sized(of_a_step, 1e-9, 1e-9, noise=0.0).refusal


@pytest.mark.parametrize(
    ("rms", "noise", "order", "said"),
    [
        (
            0.12,
            1.0,
            2.0,
            ("0.12 times the noise", "model.step = 0.05", "makes this error negligible"),
        ),
        (1e-9, 0.0, 1.0, ("an error of 1e-09 times the remaining residual",)),
        (0.04, 1.0, 1.0, ()),
        (0.0, 0.0, 1.0, ()),
    ],
)
def test_a_smaller_error_is_a_note_and_a_negligible_one_is_none(of_a_step, rms, noise, order, said):
    notes = sized(of_a_step, rms, 1.0, order, noise).notes
    assert len(notes) == bool(said)
    assert all(part in notes[0] for part in said)


def test_a_loose_tolerance_is_spoken_of_however_small_its_error_is_here():
    solver = Solver("dormand_prince", rtol=1e-3)
    found, _ = error_and_truth(replace(DATA, model=replace(DATA.model, solver=solver)), DATA)
    (note,) = sized(found, 1e-5, 1.0, np.nan).notes
    assert "1e-05 times the noise" in note
    assert "negligible here; set model.rtol = 1e-04 to keep it negligible in other cases" in note


def test_what_could_not_be_measured_is_said(of_a_step):
    found = replace(sized(of_a_step, 0.0, 0.0), why_not="it communicates in a fixed step")
    assert "could not be measured: it communicates in a fixed step" in found.notes[-1]
    assert not found.hides_effects
