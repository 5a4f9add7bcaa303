"""The product of methods and classical problems: what each method is for, and how closely.

A new method joins by an entry in ENTRIES; the contract tests do the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from support.problems.constrained import CONSTRAINED
from support.problems.functions import PROBLEMS, FunctionProblem
from support.problems.nist import read
from support.problems.rough import ROUGH

from cluster_est.methods import (
    AsynchronousPatternSearch,
    Cmaes,
    DifferentialEvolution,
    GeneticAlgorithm,
    Isres,
    LeastSquares,
    Method,
    NelderMead,
    Nsga2,
    ParticleSwarm,
    PatternSearch,
    ScipyLeastSquares,
    Sqp,
)

SMOOTH, REGRESSION, ROUGHNESS = "smooth", "regression", "roughness"
INEQUALITY, EQUALITY = "inequality constraints", "equality constraints"
CONSTRAINTS = (INEQUALITY, EQUALITY)
ALL = (SMOOTH, REGRESSION, ROUGHNESS, *CONSTRAINTS)


@dataclass(frozen=True)
class Entry:
    """A method, what it is for, and how closely it must find a minimum.

    Attributes
    ----------
    method
        With the options that it needs here.
    kinds
        Of the problems that it is tried on. SMOOTH for nearly every method;
        REGRESSION too if it follows narrow valleys from far away, as one that spreads points over a
        box does not; ROUGHNESS if it needs no derivatives; INEQUALITY if its class says
        `keeps_constraints`, EQUALITY if `keeps_equality` too.
    accuracy
        The part of the start's distance to the minimum that it may leave.
    boxed
        Problems are given a wide box in place of bounds that are not finite: for a method with
        `needs_bounds`, or that searches much better within bounds.
    constrained
        The part that it may leave where there are inequality constraints, if that is another.
    quick
        Solves a problem in a tenth of a second: the default run has all of them, and of other
        methods one problem of each kind.
    """

    method: Method
    kinds: tuple[str, ...]
    accuracy: float
    boxed: bool = False
    constrained: float | None = None
    quick: bool = False

    def __str__(self) -> str:
        return repr(self.method)

    def accuracy_on(self, case: Case) -> float:
        """The part of the start's distance to the minimum that it may leave there."""
        if case.kind == INEQUALITY and self.constrained is not None:
            return self.constrained
        return self.accuracy


CURVES = (SMOOTH, REGRESSION)
ANY_SHAPE = (SMOOTH, REGRESSION, ROUGHNESS)
IN_A_BOX = (SMOOTH, ROUGHNESS, INEQUALITY)
SIMPLEX = NelderMead(bounds="enforce", xtol=1e-8, ftol=1e-12)

ENTRIES = [
    Entry(LeastSquares(max_iterations=300), (*CURVES, *CONSTRAINTS), 1e-8, quick=True),
    Entry(LeastSquares(trials=1, max_iterations=300), CURVES, 1e-8, quick=True),
    Entry(ScipyLeastSquares(), CURVES, 1e-8, quick=True),
    Entry(ScipyLeastSquares(algorithm="dogbox"), CURVES, 1e-8, quick=True),
    Entry(Sqp(max_iterations=300), (*CURVES, *CONSTRAINTS), 1e-8, quick=True),
    Entry(Sqp(algorithm="slsqp", max_iterations=300), (*CURVES, *CONSTRAINTS), 1e-6, quick=True),
    Entry(Sqp(algorithm="trust_constr", max_iterations=1500), (SMOOTH, *CONSTRAINTS), 1e-4),
    Entry(SIMPLEX, ANY_SHAPE, 1e-5, quick=True),
    Entry(replace(SIMPLEX, parallel=2, speculative=True), ANY_SHAPE, 1e-2),
    Entry(replace(SIMPLEX, coefficients="classical"), (SMOOTH,), 1e-8, quick=True),
    Entry(PatternSearch(), ALL, 1e-5),
    Entry(PatternSearch(basis="n+1"), ALL, 1e-5),
    Entry(AsynchronousPatternSearch(), ALL, 1e-5),
    Entry(DifferentialEvolution(), IN_A_BOX, 1e-3, boxed=True, constrained=1e-5),
    Entry(Cmaes(), IN_A_BOX, 1e-3, boxed=True, constrained=1e-5),
    Entry(ParticleSwarm(max_generations=150), IN_A_BOX, 1e-2, boxed=True, constrained=1e-4),
    Entry(GeneticAlgorithm(max_generations=80), IN_A_BOX, 0.03, boxed=True, constrained=0.02),
    Entry(Isres(max_generations=300), CONSTRAINTS, 1e-3, boxed=True, constrained=1e-5),
    # gives a front instead of a minimum; its own tests are in test_populations.py
    Entry(Nsga2(), (), np.nan, boxed=True),
]

DOGBOX = "stops early where a bound is active on the way, as documented"
EXCUSES = {
    ("dogbox", "bard bounded"): DOGBOX,
    ("dogbox", "rosenbrock bounded"): DOGBOX,
    ("GeneticAlgorithm", "kowalik osborne"): "does not follow a flat and narrow valley to its end",
    ("Isres", "hs48"): "only the start satisfies the equalities, and no random point ever will",
    ("trust_constr", "hs15"): "creeps along the edge and ends before the constraints are satisfied",
    ("trust_constr", "hs26"): "needs thousands of iterations where the Hessian is singular",
}
"""Which part of a method's repr fails on which problem, and why that is known."""


def excuse(entry: Entry, case: Case) -> str:
    """Why this method need not solve this problem; empty if it must."""
    reasons = [
        why for (part, name), why in EXCUSES.items() if part in str(entry) and name == str(case)
    ]
    return reasons[0] if reasons else ""


def boxed(problem: FunctionProblem) -> FunctionProblem:
    """The same problem with a wide box in place of bounds that are not finite."""
    start = np.array(problem.start)
    room = 3.0 * max(1.0, float(np.abs(start).max()))
    lower, upper = (
        np.full(len(start), sign * np.inf) if bounds is None else np.array(bounds, np.float64)
        for sign, bounds in ((-1.0, problem.lower), (1.0, problem.upper))
    )
    return replace(
        problem,
        lower=tuple(np.where(np.isfinite(lower), lower, start - room).tolist()),
        upper=tuple(np.where(np.isfinite(upper), upper, start + room).tolist()),
    )


@dataclass(frozen=True)
class Case:
    """A classical problem of one kind. A method may end `tolerance` above the minimum."""

    kind: str
    problem: FunctionProblem
    tolerance: float = 1e-12

    def __str__(self) -> str:
        return self.problem.name

    @property
    def minima(self) -> tuple[float, ...]:
        """The least, and a local one that a search downhill may end in."""
        return self.problem.minimum, *LOCAL_MINIMA.get(self.problem.name, ())

    @property
    def scale(self) -> float:
        """What is a large difference between costs: that of the start, or the minimum itself."""
        residuals = self.problem.residuals(np.array(self.problem.start))
        start = self.problem.cost.value(residuals, np.zeros(len(residuals), np.int64))
        return max(abs(start - self.problem.minimum), abs(self.problem.minimum))


LOCAL_MINIMA = {"hs15": (360.3797671743,), "freudenstein roth": (48.98425367924,)}
"""Of hs15: the least of its cost on the branch x0 < 0 of the edge x0 x1 = 1. The other's is from
More, Garbow, Hillstrom (1981)."""
REGRESSIONS = ("Misra1a", "DanWood", "Roszman1", "Kirby2", "MGH09", "Rat43")
"""Two of each of NIST's three levels of difficulty; `least_squares` has to solve all 27."""

CASES = [
    *(Case(SMOOTH, problem) for problem in PROBLEMS),
    *(Case(REGRESSION, read(name).problem(2)) for name in REGRESSIONS),
    *(Case(EQUALITY if any(p.equality) else INEQUALITY, p) for p in CONSTRAINED),
    *(Case(ROUGHNESS, problem, tolerance) for problem, tolerance in ROUGH),
]
