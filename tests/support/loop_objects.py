"""Real objects of a closed loop from a few numbers: what a search would have left behind.

Their only parameter is "k", and nothing can be simulated: the tests that use them look at
residuals, directions and what is said of them.
"""

from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from support.problems.functions import FunctionExecutor
from support.problems.springs import FMU

from cluster_est import Experiment, LoopSettings, Model, Output, Parameter, Problem, Result, Solver
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.screen import CandidateRanking, ScreeningResult
from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.refits import RefittedCandidate
from cluster_est.closed_loop.selection.rounds import (
    RejectionReason,
    RoundStart,
    SelectionResult,
    SelectionRound,
)
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.search_space import make_space
from cluster_est.results.output_errors import OutputError
from cluster_est.running.runner import Runner
from cluster_est.statistics.projection import OrthogonalProjection, ProjectedResidual
from cluster_est.statistics.records import make_records
from cluster_est.statistics.score import score
from cluster_est.statistics.whiteness import SmoothnessTest
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.fmu.description import ModelDescription, describe_model
from workers.messages import Effect, FloatArray, Role

FORM_OF_FAMILY = {
    "friction": "coulomb",
    "table": "table",
    "load": "drift",
    "hidden dynamics": "hidden_exchange",
}
"""A form of the library for a family, at a state derivative."""
NO_STRUCTURE = SmoothnessTest(0.5, 6.0)


def made_experiments(
    *lengths: int, outputs: int = 1, sigma: float = 1.0, roles: Sequence[Role] = ()
) -> tuple[Experiment, ...]:
    """An experiment "run 0", "run 1" ... for each length, with outputs "y0", "y1" ... over 1 s."""
    runs = []
    for e, n in enumerate(lengths):
        times, zeros = np.linspace(0.0, 1.0, n), np.zeros(n)
        seen = tuple(Output(f"y{i}", times, zeros, sigma) for i in range(outputs))
        role = roles[e] if roles else "train"
        runs.append(Experiment(f"run {e}", 0.0, 1.0, (), seen, role=role))
    return tuple(runs)


def made_problem(*lengths: int, **more: Any) -> Problem:
    """A problem of such experiments."""
    model = Model("none", b"", "model_exchange", Solver("rk4"), ("k",))
    return Problem(model, (Parameter("k", 1.0, (0.0, 10.0)),), made_experiments(*lengths, **more))


def made_fitter(problem: Problem) -> Fitter:
    """A fitter of its training experiments."""
    train = problem.indices("train")
    return Fitter(
        runner=Runner(FunctionExecutor(_never)),
        problem=problem,
        description=_description(),
        seed=0,
        train=train,
        records=make_records([problem.experiments[e] for e in train]),
        synthetic={},
        everything=problem,
        meter=SimpleNamespace(full=0.0),  # type: ignore[arg-type]
        noise_of_samples={},
        sigma_declared=any(o.sigma != 1.0 for e in problem.experiments for o in e.outputs),
    )


def made_fit(
    problem: Problem, residuals: FloatArray, added: Sequence[EffectCandidate] = ()
) -> FittedModel:
    """A model whose fit left these residuals."""
    space = make_space(problem, problem.indices("train"))
    assert len(residuals) == space.rows[-1].stop
    jacobian = np.zeros((len(residuals), space.size))
    return FittedModel(space, space.start, np.asarray(residuals, float), jacobian, tuple(added))


def fit_with_squares(
    problem: Problem, total: float, added: Sequence[EffectCandidate] = ()
) -> FittedModel:
    """A model whose residuals are all of one size and have this sum of squares."""
    size = make_space(problem, problem.indices("train")).rows[-1].stop
    return made_fit(problem, np.full(size, np.sqrt(total / size)), added)


def made_candidate(name: str, family: str = "friction") -> EffectCandidate:
    """An effect of this name at der(v), in a form of the family."""
    form = FORMS["derivative", FORM_OF_FAMILY[family]]
    assert form.family == family
    site = EffectSite("derivative", "v")
    count = len(form.coefficients)
    effect = Effect(name, str(site), form.name, ("v",))
    return EffectCandidate(
        effect, form, site, True, ((0.0,) * count,), (-1.0,) * count, (1.0,) * count
    )


def made_ranking(
    matrix: FloatArray,
    residuals: FloatArray,
    columns: Sequence[FloatArray],
    candidates: Sequence[EffectCandidate],
) -> CandidateRanking:
    """These candidates' directions against a residual; whitening changes nothing."""
    projection = OrthogonalProjection(matrix)
    scores = score(projection, residuals, columns)
    residual = ProjectedResidual(projection, residuals)
    return CandidateRanking(
        trials=tuple(CandidatePoint(c, c.grid[0]) for c in candidates),
        columns=tuple(columns),
        rows=np.arange(len(residuals)),
        records=make_records(made_problem(len(residuals)).experiments),
        plain=scores,
        white=scores,
        residual=residual,
        residual_white=residual,
    )


def made_screening(
    matrix: FloatArray,
    residuals: FloatArray,
    columns: Sequence[FloatArray],
    candidates: Sequence[EffectCandidate],
    *,
    structure: SmoothnessTest = NO_STRUCTURE,
    structure_white: SmoothnessTest | None = None,
    p: float = 0.2,
    p_white: float = 0.3,
) -> ScreeningResult:
    """A ranking, and what the tests of it said."""
    return ScreeningResult(
        made_ranking(matrix, residuals, columns, candidates),
        structure=structure,
        structure_white=structure_white or structure,
        p=p,
        p_white=p_white,
    )


def made_round(why: RejectionReason | None, screening: ScreeningResult) -> SelectionRound:
    """A round in which nothing was added."""
    return SelectionRound(screening, (), why)


def made_refit(fitted: FittedModel, criterion: float) -> RefittedCandidate:
    """A larger structure, refitted to convergence."""
    return RefittedCandidate(fitted, criterion, True)


def made_start(
    base: FittedModel,
    screening: ScreeningResult,
    *,
    predicted: float,
    floor: float,
    numerical: float = 0.0,
) -> RoundStart:
    """A round that begins at the declared model, from which nothing has been grown yet."""
    prediction = LeaveOneOutPrediction(np.array([predicted]))
    return RoundStart(
        base, base, prediction, screening, floor, LoopSettings(), False,
        numerical=numerical,
    )  # fmt: skip


def made_selection(
    base: FittedModel,
    current: FittedModel,
    last: SelectionRound,
    *,
    squares_before: FloatArray | None = None,
    squares: FloatArray | None = None,
    noise: Sequence[float] = (1.0,),
    settings: LoopSettings | None = None,
) -> SelectionResult:
    """A search that ended; what is predicted is what was fitted, unless it is given."""
    own, now = (_by_experiment(fit) for fit in (base, current))
    return SelectionResult(
        base=base,
        current=current,
        base_prediction=LeaveOneOutPrediction(own if squares_before is None else squares_before),
        prediction=LeaveOneOutPrediction(now if squares is None else squares),
        rivals={},
        steps=(last,),
        findings=(),
        noise=np.array(noise),
        settings=LoopSettings() if settings is None else settings,
    )


def made_result(problem: Problem, errors: Sequence[OutputError]) -> Result:
    """A fit's result of which only the errors are looked at."""
    solution = Solution(np.ones(1), 0.0, Ending.CONVERGED)
    return Result(
        problem=problem,
        estimates=(),
        solution=solution,
        test_solution=None,
        cost_before=0.0,
        cost=0.0,
        errors=tuple(errors),
        simulations=(),
        evaluations=0,
        simulated=0,
        failures=0,
        seconds=0.0,
    )


def _by_experiment(fitted: FittedModel) -> FloatArray:
    return np.array([float(np.sum(fitted.residuals[rows] ** 2)) for rows in fitted.space.rows])


@cache
def _description() -> ModelDescription:
    return describe_model(
        Model(FMU.name, FMU.read_bytes(), "model_exchange", Solver("rk4"), ("k",))
    )


def _never(x: FloatArray) -> FloatArray:
    raise AssertionError("nothing can be simulated here")
