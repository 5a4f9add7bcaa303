"""An effect that stands in the C source of the FMU that made the data, and nowhere else, is found.

The truth is `tests/fmus/lenient_models/spring_with_more/model.c`. What is fitted is the plain
mass-spring-damper from parameters that are wrong by a fifth, and no problem mentions the effect.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from closed_loop_benchmark import waveforms
from support.problems.springs import FMU

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

TIMES = np.arange(450) * 0.02
TRUE = {"m": 1.2, "k": 30.0, "c": 0.6}
WRONG = {"m": 0.96, "k": 36.0, "c": 0.48}
STARTS = {
    "multisine": 0.1,
    "steps": 0.0,
    "chirp": -0.05,
    "binary": 0.0,
    "triangle": 0.05,
    "ramps": 0.0,
}
HELD_OUT = ("triangle", "ramps")
SHARE = 0.01
"""Noise over the standard deviation of the output."""

Name = tuple[str, str, tuple[str, ...]]


@dataclass(frozen=True)
class Case:
    """What the C source has and the FMU under test lacks.

    Attributes
    ----------
    effect
        Values of the parameters of spring_with_more that switch it on.
    names
        Site, form and variables by which it may be found.
    expected
        Coefficients of the library's equation, from the C source.
    sigma
        Whether the noise is given.
    """

    effect: dict[str, float]
    names: tuple[Name, ...]
    expected: dict[str, float]
    sigma: bool


CASES = {
    # friction dry tanh(v / 1e-4) over the mass
    "friction": Case({"dry": 0.5}, (("der(v)", "coulomb", ("v",)),), {"k": 0.5 / 1.2}, True),
    "friction, sigma unknown": Case(
        {"dry": 0.5}, (("der(v)", "coulomb", ("v",)),), {"k": 0.5 / 1.2}, False
    ),
    # A lag at the input does the same to the forced motion, but the free motion from `STARTS` is
    # delayed by the sensor alone.
    "slow sensor": Case({"slow": 0.04}, (("output y", "lag", ()),), {"tau": 0.04}, False),
    "bent sensor": Case({"bend": 0.6}, (("output y", "square", ()),), {"k": 0.6}, True),
    "dead zone": Case({"dead": 0.5}, (("input F", "dead_zone", ()),), {"k": 0.5}, False),
    "ageing": Case({"ageing": 0.02}, (("parameter k", "drift", ()),), {"k": 0.02}, True),
    # -k (1 + r |x|) x / m is -k x / m - (k r / m) x |x|
    "hardening": Case(
        {"hardening": 1.0},
        (("parameter k", "magnitude", ("x",)), ("der(v)", "quadratic", ("x",))),
        {"k": 1.0},
        False,
    ),
}


def forces() -> dict[str, np.ndarray]:
    random = np.random.default_rng(20)
    return {
        "multisine": 5.0 * waveforms.multisine(TIMES, random, 0.1, 2.5),
        "steps": 4.0 * waveforms.held(TIMES, random, 0.6),
        "chirp": 2.0 * waveforms.chirp(TIMES, 0.2, 2.0),
        "binary": 3.0 * waveforms.binary(TIMES, random, 0.5),
        "triangle": 4.0 * waveforms.triangle(TIMES, 1.7),
        "ramps": 6.0 * waveforms.ramps(TIMES, random, 0.4),
    }


def driven(
    curves: dict[str, np.ndarray], sigma: float, values: Callable[[float], dict[str, float]]
) -> tuple[ce.Experiment, ...]:
    """All experiments, with what is measured and the values that follow from a start."""
    runs = []
    for name, force in forces().items():
        given, seen = ce.Input("F", TIMES, force), ce.Output("y", TIMES, curves[name], sigma)
        known, role = values(STARTS[name]), "test" if name in HELD_OUT else "train"
        runs.append(ce.Experiment(name, 0.0, TIMES[-1], (given,), (seen,), known, role=role))
    return tuple(runs)


def measure(archive: bytes, effect: dict[str, float]) -> dict[str, np.ndarray]:
    """What the spring with the effect in its C source does, to ten digits."""
    nothing = dict.fromkeys(STARTS, np.zeros_like(TIMES))
    runs = driven(nothing, 1.0, lambda start: {"x": start, "shown": start, **effect})
    solver = ce.Solver("dormand_prince", rtol=1e-9, atol=1e-10)
    model = ce.Model("spring_with_more", archive, "model_exchange", solver, ())
    # Measured are zeros, so the residuals are the outputs, with the sign turned.
    found = ce.simulate(ce.Problem(model, (), runs))
    return {run.id: -s.outcome.residuals for run, s in zip(runs, found, strict=True)}


def draw(correlation: float = 0.0) -> dict[str, np.ndarray]:
    """Noise of unit variance, white or AR(1)."""
    random = np.random.default_rng(21)
    found = {}
    for name in STARTS:
        wave = random.normal(size=len(TIMES))
        for n in range(1, len(wave)):
            fresh = np.sqrt(1.0 - correlation**2) * wave[n]
            wave[n] = correlation * wave[n - 1] + fresh
        found[name] = wave
    return found


@dataclass(frozen=True)
class Measured:
    """A problem of the plain model with its data, and the noise that is in them."""

    problem: ce.Problem
    sigma: float
    noise: dict[str, np.ndarray]

    def drawn(self, name: str) -> float:
        """Root mean square of what was added to a record: the least that can be left."""
        return float(np.sqrt(np.mean(self.noise[name] ** 2)))


def declared(curves: dict[str, np.ndarray], sigma: float) -> ce.Problem:
    """What a user would have, who knows of the plain model only."""
    runs = driven(curves, sigma, lambda start: {"x": start})
    bounds = {"m": (0.2, 5.0), "k": (5.0, 150.0), "c": (0.0, 5.0)}
    parameters = tuple(ce.Parameter(n, WRONG[n], *bounds[n]) for n in TRUE)
    return ce.Problem(ce.read_model(FMU, list(TRUE)), parameters, runs)


@pytest.fixture(scope="module")
def prepared(built_fmu):
    """Make the data of an effect once."""

    @cache
    def prepare(effect: tuple[tuple[str, float], ...], given: bool, correlation: float = 0.0):
        curves = measure(built_fmu("spring_with_more"), dict(effect))
        size = SHARE * float(np.concatenate([curves[n] for n in curves if n not in HELD_OUT]).std())
        noise = {name: size * wave for name, wave in draw(correlation).items()}
        noisy = {name: curve + noise[name] for name, curve in curves.items()}
        return Measured(declared(noisy, size if given else 1.0), size, noise)

    return prepare


@pytest.fixture(scope="module")
def closed(prepared):
    """Close the loop on a case, once for all tests of it."""

    @cache
    def close(name: str) -> tuple[Measured, ce.LoopResult]:
        case = CASES[name]
        made = prepared(tuple(case.effect.items()), case.sigma)
        return made, ce.close_loop(made.problem)

    return close


def at_rest(result: ce.LoopResult) -> tuple[dict[str, float], dict[str, float]]:
    """The declared parameters and the effect's coefficients, in the C source's terms."""
    (effect,) = result.effects
    parameters = {n: result.after.x[n] for n in TRUE}
    numbers = {e.parameter.removeprefix(f"{effect.name}."): e.value for e in effect.coefficients}
    if effect.site == "parameter k":  # p (1 + q (phi - at)): what it is at phi = 0, and its slope
        share = 1.0 - numbers["k"] * numbers["at"]
        parameters["k"] *= share
        numbers["k"] /= share
    elif effect.form == "quadratic":
        numbers["k"] *= parameters["m"] / parameters["k"]
    return parameters, numbers


def distance(parameters: dict[str, float]) -> float:
    """Root mean square of the logarithmic errors."""
    return float(np.sqrt(np.mean([np.log(parameters[n] / TRUE[n]) ** 2 for n in TRUE])))


SLOW = {*CASES} - {"bent sensor", "ageing"}
"""A friction and a dead zone are found by default in `test_close_loop.py` and small searches."""
each_case = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in CASES]
)


@each_case
def test_it_is_found_at_its_site_under_its_name(closed, name):
    result = closed(name)[1]
    assert result.verdict == Verdict.FOUND
    assert [(e.site, e.form, e.variables) in CASES[name].names for e in result.effects] == [True]
    assert result.rejected == ()


@each_case
def test_its_coefficients_are_those_of_the_c_source(closed, name):
    parameters, numbers = at_rest(closed(name)[1])
    for coefficient, true in CASES[name].expected.items():
        assert numbers[coefficient] == pytest.approx(true, rel=0.02)
    for parameter, true in TRUE.items():
        assert parameters[parameter] == pytest.approx(true, rel=0.02)
    assert distance(parameters) < 0.5 * distance(closed(name)[1].before.x)


@each_case
def test_errors_fall_to_the_noise_in_training_and_held_out(closed, name):
    made, result = closed(name)
    assert {e.experiment for e in result.errors if e.role == "test"} == set(HELD_OUT)
    assert len(result.errors) == len(STARTS)
    unit = made.sigma if CASES[name].sigma else result.noise["y"]
    for error in result.errors:
        assert (error.output, error.unit, error.samples) == ("y", "m", len(TIMES))
        # Hardly more in one record: of a force with two levels a dead zone takes a share, as the
        # wrong parameters do.
        assert error.rmse_before > 1.2 * made.sigma
        assert error.rmse_after == pytest.approx(made.drawn(error.experiment), rel=0.05)
        assert error.normalised_before * unit == pytest.approx(error.rmse_before)
        assert error.normalised_after * unit == pytest.approx(error.rmse_after)
    for role in ("train", "test"):
        drawn = [made.drawn(e.experiment) ** 2 for e in result.errors if e.role == role]
        assert result.rms(role, "before") * unit > 5.0 * made.sigma
        assert result.rms(role, "after") * unit == pytest.approx(np.sqrt(np.mean(drawn)), rel=0.03)
    assert result.noise["y"] == pytest.approx(made.sigma, rel=0.1)


@pytest.mark.parametrize(
    ("correlation", "given", "verdict"),
    [
        pytest.param(0.0, True, Verdict.NONE, id="white, sigma"),
        pytest.param(0.8, False, Verdict.COLOURED, id="AR, no sigma"),
        pytest.param(0.0, False, Verdict.NONE, id="white, no sigma", marks=pytest.mark.slow),
        pytest.param(0.8, True, Verdict.COLOURED, id="AR, sigma", marks=pytest.mark.slow),
    ],
)
def test_without_an_effect_nothing_is_found(prepared, given, correlation, verdict):
    made = prepared((), given, correlation)
    result = ce.close_loop(made.problem)
    assert result.verdict == verdict
    assert result.effects == result.rejected == ()
    assert result.after is result.before
    for error in result.errors:
        assert error.rmse_after == error.rmse_before
        assert error.rmse_after == pytest.approx(made.drawn(error.experiment), rel=0.02)
    for parameter, true in TRUE.items():
        assert result.after.x[parameter] == pytest.approx(true, rel=0.02)
