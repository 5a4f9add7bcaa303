"""A model of twelve states that lacks a leak at one: its candidates are looked at by their places.

The data come from the matrix exponential of the rod's equations.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from support.truth.systems_with_missing_effects import opened

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.screening.screen import CandidateRanking, rank
from cluster_est.closed_loop.settings import LoopStage

NODES, LEAKING, MEASURED = 12, 8, (2, 5, 8, 11)
TRUE = {"conduction": 0.3, "loss": 0.005}
LEAK = 0.05
SIGMA = 0.02
TIMES = np.arange(300) * 0.8
ROLES = ("train", "train", "train", "test")


def heating(number: int) -> np.ndarray:
    """Steps of random height, each held for some seconds."""
    random = np.random.default_rng([4, number])
    return np.repeat(random.uniform(0.0, 3.0, len(TIMES) // 20), 20)


def leaking() -> np.ndarray:
    """What one node loses by the leak, (nodes, nodes)."""
    rates = np.zeros((NODES, NODES))
    rates[LEAKING - 1, LEAKING - 1] = -LEAK
    return rates


def storing(node: int, k: float, tau: float) -> np.ndarray:
    """A hidden store behind a node, as a further one."""
    rates = np.zeros((NODES + 1, NODES + 1))
    rates[node - 1, [node - 1, NODES]] = -k, k
    rates[NODES, [node - 1, NODES]] = 1.0 / tau, -1.0 / tau
    return rates


def temperatures(heat: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """(times, nodes): exact for heating that is held between the samples."""
    neighbours = np.eye(NODES, k=1) + np.eye(NODES, k=-1)
    rates = missing.copy()
    size = len(rates)
    rates[:NODES, :NODES] += TRUE["conduction"] * (neighbours - np.diag(neighbours.sum(axis=1)))
    rates[:NODES, :NODES] -= TRUE["loss"] * np.eye(NODES)
    joined = np.zeros((size + 1, size + 1))
    joined[:size, :size], joined[0, size] = rates, 1.0
    step = expm(joined * (TIMES[1] - TIMES[0]))
    found = np.zeros((len(TIMES), size))
    for n in range(len(TIMES) - 1):
        found[n + 1] = step[:size, :size] @ found[n] + step[:size, size] * heat[n]
    return found[:, :NODES]


def experiment(number: int, missing: np.ndarray) -> ce.Experiment:
    random = np.random.default_rng([5, number])
    heat = heating(number)
    curves = temperatures(heat, missing) + SIGMA * random.normal(size=(len(TIMES), NODES))
    outputs = tuple(ce.Output(f"y{i}", TIMES, curves[:, i - 1], SIGMA) for i in MEASURED)
    given = (ce.Input("heating", TIMES, heat, "hold"),)
    return ce.Experiment(f"e{number}", 0.0, float(TIMES[-1]), given, outputs, role=ROLES[number])


def rod(fmu: bytes, missing: np.ndarray) -> ce.Problem:
    model = ce.Model(
        "heat_rod",
        fmu,
        "model_exchange",
        ce.Solver("dormand_prince"),
        tuple(TRUE),
    )
    parameters = tuple(ce.Parameter(n, 0.8 * v, (0.1 * v, 10.0 * v)) for n, v in TRUE.items())
    runs = tuple(experiment(e, missing) for e in range(len(ROLES)))
    return ce.Problem(model, parameters, runs)


@pytest.fixture(scope="module")
def problem(built_fmu):
    return rod(built_fmu("heat_rod"), leaking())


@pytest.mark.slow
def test_the_leak_is_found_at_its_node_and_errors_fall_to_the_noise(problem):
    found = ce.close_loop(problem)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.site, effect.variables) == (f"der(T{LEAKING})", (f"T{LEAKING}",))
    (leak,) = (each.value for each in effect.coefficients)
    assert leak == pytest.approx(LEAK, rel=0.05)
    assert found.rms("test", "before") > 2.0
    assert found.rms("test", "after") == pytest.approx(1.0, abs=0.1)


def ranking(problem: ce.Problem) -> CandidateRanking:
    """All candidates at the declared model, fitted."""
    with opened(problem) as bench:
        start = FitStart(bench.fitter.problem, {})
        (fitted,) = bench.fitter.fit(LoopStage.DECLARED_MODEL, [start], ce.LeastSquares())
        return rank(bench.fitter, bench.settings, fitted)


@pytest.fixture(scope="module")
def ranked(problem):
    return ranking(problem)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [(3, 0.087, 13.0), (2, 0.0054, 47.0)])
def test_a_hidden_store_is_looked_for_at_its_node(built_fmu, hidden):
    """A function of the node's temperature explains less there than functions do elsewhere."""
    found = ranking(rod(built_fmu("heat_rod"), storing(*hidden)))
    stores = {t.candidate.effect.site for t in found.trials if t.candidate.form.name == "store"}
    assert f"der(T{hidden[0]})" in stores


@pytest.mark.slow
def test_the_node_of_the_leak_leads(ranked):
    """The temperature of the next node is nearly the same: which of them counts, refits say."""
    first = [ranked.trials[i].candidate.effect for i in ranked.leaders(ranked.white, 3)]
    assert {each.site for each in first} == {f"der(T{LEAKING})"}


@pytest.mark.slow
def test_pairs_are_those_of_neighbours(ranked):
    """No heat flows between nodes that do not touch."""
    sites = {trial.candidate.site for trial in ranked.trials}
    pairs = {site.targets for site in sites if site.kind == "pair"}
    touching = {(f"T{i}", f"T{i + 1}") for i in range(1, NODES)}
    assert pairs
    assert pairs <= touching | {(b, a) for a, b in touching}


def test_the_price_is_that_of_all_that_was_looked_at(ranked):
    """At 12 nodes functions of 12 temperatures, some ten of each, and more at inputs and pairs."""
    assert 1_500 < ranked.count < 30_000
