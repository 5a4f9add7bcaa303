"""A fit: search, examine the solution, complete the result, refine the intervals."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Method, Solution
from cluster_est.problem.compatibility import check_observed_outputs, check_priors
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import check_process_noise
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results import fit_tables as rows
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.interpolation import InterpolationTest, examine_interpolations
from cluster_est.results.output_errors import Simulation
from cluster_est.results.record_faults.find import faults_of_fit
from cluster_est.results.residual_diagnostics import diagnose_residuals
from cluster_est.results.result import Result
from cluster_est.results.solver_error.measure import measure_solver_error
from cluster_est.results.states import with_states
from cluster_est.running.arguments import (
    check_method,
    check_problem,
    check_values,
    checked_resources,
    method_of,
    prepared,
)
from cluster_est.running.environment import RunEnvironment, open_executor
from cluster_est.running.multistart import (
    Multistart,
    check_starts,
    search_from_starts,
)
from cluster_est.running.progress_line import Callback
from cluster_est.running.resources import Record, Resources, Show, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.sizes import with_sizes
from cluster_est.running.study import Study, run_study
from cluster_est.shooting.carried_states import with_carried_states
from cluster_est.shooting.record_segments import Shooting
from cluster_est.shooting.shoot import SearchResult, check_shooting, fit_whole_records, shoot
from cluster_est.uncertainty import (
    UncertaintySettings,
    bootstrap,
    check_bootstrap,
    check_posterior,
    check_profiles,
    examine,
    linearise,
    predicted_bands,
    profiles,
    sample_posterior,
)
from workers.messages.checks import check_kind, check_number

POSTERIOR = 3
"""Number of the random stream for the posterior."""

SearchStep = Callable[[Runner, SearchSpace], SearchResult]


@dataclass(frozen=True)
class Fit(Study[Result]):
    """The estimation of all unknowns of a problem from its training experiments.

    Attributes
    ----------
    problem
        Model, parameters and experiments.
    method
        Method of the search.
    seed
        Random seed of the method.
    multistart
        Number of starts, and related settings.
    uncertainty
        Intervals to compute by refits.
    shooting
        Segments of the records for a first search; None for only whole records.
    """

    problem: Problem
    method: Method = field(default_factory=LeastSquares)
    seed: int = 0
    multistart: Multistart = field(default_factory=Multistart)
    uncertainty: UncertaintySettings = field(default_factory=UncertaintySettings)
    shooting: Shooting | None = None

    @override
    def check(self) -> None:
        check_problem(self.problem)
        check_kind(self.multistart, Multistart, "multistart", ProblemError)
        check_kind(self.uncertainty, UncertaintySettings, "uncertainty", ProblemError)
        check_number(self.seed, "method.seed", ProblemError, least=0, whole=True)
        if self.shooting is not None:
            check_kind(self.shooting, Shooting, "method.shooting", ProblemError)
            if self.multistart.searches > 1:
                raise ProblemError(
                    "method.shooting: starts once, at the start values of the parameters, but "
                    f"multistart asks for {self.multistart.searches} starts; leave one of the two "
                    "out"
                )
        self.problem.describe()
        self.space()
        make_space(self.problem, self.problem.indices("test"))

    def space(self) -> SearchSpace:
        """Return the search space of the training experiments, if all settings suit it.

        Raises
        ------
        ProblemError
            If the method, the starts or the intervals do not suit the problem.
        """
        check_priors(self.problem)
        check_observed_outputs(self.problem)
        check_process_noise(self.problem)
        train = make_space(self.problem, self.problem.indices("train"))
        check_method(self.method, train)
        check_starts(train, self.multistart)
        check_profiles(train, self.uncertainty)
        if self.uncertainty.bootstrap:
            check_bootstrap(train)
        if self.uncertainty.posterior:
            check_posterior(train, self.uncertainty.walkers)
        if self.shooting is not None:
            check_shooting(train, self.method, self.shooting)
        return train

    @override
    def run(self, environment: RunEnvironment) -> Result:
        begin = time.monotonic()
        known = with_carried_states(environment, self.problem)
        result = replace(self, problem=known)._run(environment)
        result = with_states(result, environment.resources)
        return replace(result, seconds=time.monotonic() - begin)

    def _run(self, environment: RunEnvironment) -> Result:
        train = self.space()
        with one_blas_thread():
            if self.shooting is None:
                return self._searched(environment, train, self._from_starts)
            return self._through_segments(environment, train, self.shooting)

    def _from_starts(self, runner: Runner, train: SearchSpace) -> SearchResult:
        return SearchResult(
            search_from_starts(runner, train, self.method, self.multistart, self.seed)
        )

    def _through_segments(
        self, environment: RunEnvironment, train: SearchSpace, shooting: Shooting
    ) -> Result:
        """Search with segments of the records, then with whole records from that solution."""
        begin = time.monotonic()
        assert isinstance(self.method, LeastSquares)  # `check_shooting`
        shot = shoot(environment, train, self.method, shooting, self.seed)

        def search(runner: Runner, train: SearchSpace) -> SearchResult:
            found = fit_whole_records(runner, train, self.method, shot, self.seed)
            return found.without(self.uncertainty.asked)

        left = environment.left(shot.evaluations, time.monotonic() - begin)
        result = self._searched(left, train, search, interrupted=shot.interrupted)
        return replace(
            result,
            evaluations=result.evaluations + shot.evaluations,
            simulated=result.simulated + shot.simulated,
            failures=result.failures + shot.failures,
        )

    def _searched(
        self,
        environment: RunEnvironment,
        train: SearchSpace,
        search: SearchStep,
        *,
        interrupted: bool = False,
    ) -> Result:
        """Search, then examine the solution."""
        problem, steps = self.problem, GuardedSteps()
        variables = problem.describe().variables
        with environment.executor(problem) as executor:
            runner = environment.runner(executor)
            runner.interrupted, begin = interrupted, time.monotonic()
            before = simulate_all(runner, problem, {})
            train = with_sizes(runner, train)
            found = search(runner, train)
            solution = linear = found.minima.best
            whole, known = not found.segmented, None
            if whole and not runner.interrupted:
                linear = steps.do(
                    "the derivatives at the solution",
                    lambda: linearise(runner, train, solution),
                    solution,
                )
                known = steps.assessed(train, linear, lambda: examine(runner, train, linear))
            result = complete(
                runner,
                train,
                solution,
                self.method,
                before,
                variables=variables,
                seed=self.seed,
                begin=begin,
                steps=steps,
                uncertainty=known,
                segmented=found.segmented,
            )
            starts, minima = rows.starts_and_minima(train, found.minima)
            after = result.simulations
            left = steps.do(
                "the test of the residuals",
                lambda: diagnose_residuals(train, linear, after),
                None,
            )
            result = replace(
                result,
                starts=starts,
                minima=minima,
                diagnostics=left,
                shooting=found.shooting,
            )
            if whole and not runner.interrupted:
                if problem.effects:
                    result = _with_shapes(runner, train, result, steps)
                if solution.ending.success:
                    result = self._refined(runner, train, result, steps)
                if left is not None:
                    result = _with_record_faults(runner, train, linear, result, environment, steps)
            result = replace(
                result, interrupted=runner.interrupted, search_seconds=time.monotonic() - begin
            )
        if whole and not runner.interrupted:  # the workers are idle now, so a processor is free
            error = steps.do(
                "the error of the solver",
                lambda: measure_solver_error(train, solution, after, environment.resources, runner),
                None,
            )
            tested = InterpolationTest()
            if left is not None:
                tested = steps.do(
                    "the other interpolation of inputs",
                    lambda: examine_interpolations(
                        train, linear, after, environment.resources, runner
                    ),
                    tested,
                )
            result = replace(
                result,
                solver_error=error,
                interpolation=tested.preferred,
                linear_inputs=tested.linear,
            )
        return replace(result, failed_steps=tuple(steps.failed))

    def _refined(
        self, runner: Runner, train: SearchSpace, result: Result, steps: GuardedSteps
    ) -> Result:
        """Add the intervals that need further simulations: profiles, bootstrap and posterior."""
        solution, method, settings = result.solution, self.method, self.uncertainty
        local = method if method.needs_residuals else LeastSquares()
        if not _accepts(local, train):
            local = method
        profiled = steps.do(
            "profiles", lambda: profiles(runner, train, solution, local, settings), ()
        )
        drawn = None
        if settings.bootstrap:
            generator = np.random.default_rng(self.seed)
            drawn = steps.do(
                "the bootstrap",
                lambda: bootstrap(runner, train, solution, local, settings, generator),
                None,
            )
        result = replace(result, profiles=profiled, bootstrap=drawn)
        if not settings.posterior or result.uncertainty is None:
            return result
        generator = np.random.default_rng((self.seed, POSTERIOR))
        around = result.uncertainty.intervals
        posterior = steps.do(
            "the posterior",
            lambda: sample_posterior(runner, train, solution, around, settings, generator),
            None,
        )
        if posterior is None:
            return result
        own = {e.label: e.value for e in result.estimates if e.estimated_on == "test"}
        bands = steps.do(
            "predictions", lambda: predicted_bands(runner, train.problem, posterior, own), ()
        )
        return replace(result, posterior=posterior, predictions=bands)


def _with_record_faults(
    runner: Runner,
    train: SearchSpace,
    solution: Solution,
    result: Result,
    environment: RunEnvironment,
    steps: GuardedSteps,
) -> Result:
    """Add faults of records, if the residuals are more than noise."""
    before = runner.evaluations, runner.simulations, runner.failures
    faults = steps.do(
        "the faults of records",
        lambda: faults_of_fit(train, solution, result.simulations, environment.resources, runner),
        (),
    )
    return replace(
        result,
        record_faults=faults,
        evaluations=result.evaluations + runner.evaluations - before[0],
        simulated=result.simulated + runner.simulations - before[1],
        failures=result.failures + runner.failures - before[2],
    )


def _with_shapes(runner: Runner, train: SearchSpace, result: Result, steps: GuardedSteps) -> Result:
    """Add the shapes of the effects that the problem declares."""
    from cluster_est.results.shapes.visited_signals import (
        declared_shapes,  # SymPy is slow to import
    )

    shapes = steps.do(
        "the shapes of the effects", lambda: declared_shapes(runner, train, result), ()
    )
    simulated, failures = runner.simulations, runner.failures
    return replace(result, shapes=shapes, simulated=simulated, failures=failures)


def _accepts(method: Method, space: SearchSpace) -> bool:
    try:
        check_method(method, space)
    except ProblemError:
        return False
    return True


def fit(
    problem: Problem,
    method: Method | str | None = None,
    resources: Resources | Mapping[str, Any] | str | None = None,
    seed: int = 0,
    *,
    multistart: Multistart | Mapping[str, Any] | int | None = None,
    uncertainty: UncertaintySettings | Mapping[str, Any] | None = None,
    shooting: Shooting | Mapping[str, Any] | int | None = None,
    progress: Show | bool | None = None,
    callback: Callback | None = None,
    record: Record | None = None,
) -> Result:
    """Estimate all parameters of a problem jointly from its training experiments.

    Values that belong only to test records are then estimated from these records, with the shared
    values unchanged.

    Parameters
    ----------
    problem
        Model, parameters and experiments.
    method
        Method of the search, or its name as in a config ("sqp"); least squares if None.
    resources
        Where simulations run, and the budget; also "processes" or {"executor": "ray"}.
    seed
        Random seed of the method.
    multistart
        Number of starts, such as 4 or {"n": 4}; only the parameters' start values if None.
    uncertainty
        Intervals to compute by refits, such as {"profiles": True}; none if None.
    shooting
        Segments of the records for a first search, such as {"segments": 20} or {"length": 0.5}. Use
        them for chaotic, unstable or drifting models. None for only whole records.
    progress
        None for a line in a terminal or a notebook, False for no display, or a function that is
        called with a snapshot after each result.
    callback
        Called after each iteration. If it raises StopIteration, the run ends like after Ctrl-C,
        with the best point so far.
    record
        Called for each simulation; see `Runner`.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If model, experiments, method or resources are invalid.
    """
    study = Fit(
        prepared(problem),
        LeastSquares() if method is None else method_of(method),
        seed,
        Multistart.of(multistart),
        UncertaintySettings.of(uncertainty),
        None if shooting is None else Shooting.of(shooting),
    )
    return run_study(study, resources, progress=progress, callback=callback, record=record)


def simulate(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    values: Mapping[str, float] | None = None,
) -> dict[str, Simulation]:
    """Simulate every experiment once, at the start values or at values given by label.

    Returns
    -------
    dict
        Simulations by experiment id; `simulate(problem)["monday"].to_frame()` has times and
        outputs.

    Raises
    ------
    ModelError, ProblemError, ExecutorError
        If the FMU cannot be run in this way, or a label is unknown.
    """
    problem = prepared(problem)
    resources = checked_resources(resources)
    check_values(problem, values or {})
    problem.describe()
    with open_executor(problem, resources) as executor:
        found = simulate_all(Runner(executor), problem, dict(values or {}))
    return {problem.experiments[each.experiment].id: each for each in found}
