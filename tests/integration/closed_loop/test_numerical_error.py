"""The error of a solver is measured at a fit, and is not taken for something that is missing.

The truth of an error is another solver's solution with a tight tolerance.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_candidate
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    unfitted,
)

import cluster_est as ce
from cluster_est import Solver
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.loop import close_loop
from cluster_est.closed_loop.numerical_error.measure import (
    error_with_effects,
    measure_numerical_error,
)
from cluster_est.errors import ProblemError
from cluster_est.running.resources import Resources

NOISE = 0.004
TIGHT = missing_effect_problem("mass_spring_damper", signals=())
WITHOUT_SIGMA = measured(TIGHT, NOISE)
DATA = replace(
    WITHOUT_SIGMA,
    experiments=tuple(
        replace(e, outputs=tuple(replace(o, sigma=NOISE) for o in e.outputs))
        for e in WITHOUT_SIGMA.experiments
    ),
)
ADDED = made_candidate("clip")
COMMUNICATION = 0.1
INTERVAL = 0.05


def with_fixed_steps(archive: bytes) -> bytes:
    """The FMU, declared to hold its inputs over communication steps of one length."""
    found = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(found, "w") as new:
        for item in old.infolist():
            text = old.read(item)
            if item.filename == "modelDescription.xml":
                for name in (b"canHandleVariableCommunicationStepSize", b"canInterpolateInputs"):
                    text = text.replace(name + b'="true"', name + b'="false"')
            new.writestr(item, text)
    return found.getvalue()


def coarse(problem, step):
    """The same experiments, simulated in communication steps that are too long."""
    model = replace(
        problem.model,
        archive=with_fixed_steps(problem.model.archive),
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
        found = measure_numerical_error(bench, fitted, np.ones(1), Resources())
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
    found = close_loop(coarse(DATA, COMMUNICATION))
    assert found.verdict is Verdict.UNEXPLAINED
    assert found.effects == ()
    assert found.after is found.before
    assert "the communication step of 0.1 s has an error of" in found.summary
    assert "set model.step = 0.0" in found.summary
    assert any("no effect was looked for" in note for note in found.notes)


def test_its_diagnostics_say_the_same():
    problem = coarse(DATA, COMMUNICATION)
    seen = ce.detect(problem)
    assert max(seen.p, seen.p_white) <= seen.significance
    assert not seen.missing
    assert "the communication step of 0.1 s has an error of" in seen.sentence
    assert any("no effect was looked for" in note for note in seen.notes)
    with pytest.raises(ProblemError, match=r"no missing effect can be distinguished from it"):
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
        small = measure_numerical_error(bench, declared, np.ones(1), Resources())
        assert error_with_effects(bench, declared, small, np.ones(1), Resources()) is small
    with opened(clipped(problem, limit_of(problem))) as bench:
        grown = replace(unfitted(bench), added=(ADDED,))
        return small, error_with_effects(bench, grown, small, np.ones(1), Resources())


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
    assert sentence.startswith("with the effects, the communication step of")


def test_a_tolerance_keeps_the_error_of_an_effect_small():
    small, found = with_error_of_effects(thinned(DATA, 10))
    assert found is small
