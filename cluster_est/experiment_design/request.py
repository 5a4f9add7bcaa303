"""A request for a design: its models, limits and settings, checked against each other."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, InstanceOf, Strict, model_validator

from cluster_est.errors import ProblemError
from cluster_est.experiment_design.candidate_inputs import RECORDED
from cluster_est.experiment_design.criteria import CRITERIA, DesignCriterion
from cluster_est.experiment_design.limits import ExperimentLimits
from cluster_est.experiment_design.models import CandidateModel
from cluster_est.experiment_design.targets import PredictionTarget, target_experiments
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.problem.compatibility import NOT_PLAIN
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import refuse_process_noise
from cluster_est.problem.search_space import make_space
from cluster_est.problem.unknowns import Unknown
from cluster_est.settings import LARGEST_INTEGER, Names, Settings, one_of, sentence
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Experiment


class DesignSettings(Settings):
    """Purpose of an experiment, and effort of its search."""

    section: ClassVar[str] = "design"

    criterion: str = Field(
        "",
        description=(
            f"{one_of(CRITERIA)}: discriminate distinguishes the rivals of a finding; d reduces "
            "the joint uncertainty of the parameters, a that of each parameter, and v that of "
            "predictions; default: v with predictions, discriminate with rivals, else d"
        ),
    )
    parameters: Names = Field(
        (),
        description=(
            "names of the parameters whose uncertainty is to be reduced; default: all parameters "
            "that the experiments share"
        ),
    )
    rivals: Names = Field(
        (),
        description=(
            "names of the models to distinguish, as show prints them; default: all models that "
            "the run kept"
        ),
    )
    waveforms: Names = Field(
        (), description=f"families of inputs: {one_of([*WAVEFORMS, RECORDED])}; default: all"
    )
    candidates: int = Field(
        120, ge=10, le=LARGEST_INTEGER, description="number of inputs that are tried"
    )
    predictions: Annotated[tuple[InstanceOf[PredictionTarget], ...], Strict(False)] = Field(
        (),
        description="targets of the predictions, for v; default: all outputs of all experiments of "
        "the run",
    )

    @model_validator(mode="after")
    def _check_choices(self) -> Self:
        if self.criterion and self.criterion not in CRITERIA:
            known = ", ".join(repr(name) for name in CRITERIA)
            raise sentence(
                f"criterion: must be one of {known}, but is {self.criterion!r}"
                f"{nearest(self.criterion, CRITERIA)}"
            )
        if self.predictions and self.criterion and not CRITERIA[self.criterion].predicts:
            raise sentence(
                'predictions: must be used with the criterion "v", but the criterion is '
                f"{self.criterion!r}; change one of the two"
            )
        known_waveforms = [*WAVEFORMS, RECORDED]
        for name in self.waveforms:
            if name not in known_waveforms:
                raise sentence(
                    f"waveforms: each must be one of {', '.join(known_waveforms)}, but one is "
                    f"{name!r}{nearest(name, known_waveforms)}"
                )
        return self


FITTED_MODEL = "the fitted model"


@dataclass(frozen=True)
class DesignRequest:
    """A request for a design.

    Attributes
    ----------
    models
        Models that may be true, first the one that the run chose. They share the experiments.
    limits, settings
        Limits of the experiment, and its purpose.
    seed
        Seed of the random generator.
    """

    models: tuple[CandidateModel, ...]
    limits: ExperimentLimits
    settings: DesignSettings
    seed: int = 0

    @property
    def problem(self) -> Problem:
        """Problem of the first model."""
        return self.models[0].problem

    @property
    def like(self) -> Experiment:
        """The experiment of the run whose start the next experiment has."""
        problem, name = self.problem, self.limits.like
        if not name:
            return problem.experiments[problem.indices("train")[0]]
        known = {experiment.id: experiment for experiment in problem.experiments}
        if name not in known:
            raise ProblemError(
                f"like: must be an experiment of the run, but is {name!r}{nearest(name, known)}"
            )
        return known[name]

    @property
    def criterion(self) -> DesignCriterion:
        """The requested criterion, or the default for the models."""
        usual = "discriminate" if len(self.models) > 1 else "d"
        usual = "v" if self.settings.predictions else usual
        return CRITERIA[self.settings.criterion or usual]

    @property
    def targets(self) -> tuple[Experiment, ...]:
        """The experiments to predict, with the outputs that count; see `targets`."""
        if not self.criterion.predicts:
            return ()
        return target_experiments(self.settings.predictions, self.problem, self.like)


def models_of(result: object) -> tuple[CandidateModel, ...]:
    """Return the models that are possible after a fit or a closed loop.

    The chosen model is first.

    Raises
    ------
    ProblemError
        If the object is not a result.
    """
    competing = getattr(result, "competing", ())
    if competing:
        return tuple(
            CandidateModel(each.name, each.problem, each.values, each.weight) for each in competing
        )
    problem, x = getattr(result, "problem", None), getattr(result, "x", None)
    if not isinstance(problem, Problem) or not isinstance(x, dict):
        raise ProblemError(
            f"result: must be a result of fit or close_loop, but is {type(result).__name__}; fit "
            "first"
        )
    return (CandidateModel(FITTED_MODEL, problem, x),)


def chosen_models(
    models: Sequence[CandidateModel], settings: DesignSettings
) -> tuple[CandidateModel, ...]:
    """Return the first model, and the other models that should be discriminated.

    Raises
    ------
    ProblemError
        If a named model is not among them.
    """
    if not settings.rivals:
        return tuple(models)
    names = [model.name for model in models]
    for name in settings.rivals:
        if name not in names:
            raise ProblemError(
                "rivals: must be among the possible models of the run "
                f"({', '.join(map(repr, names))}), but {name!r} is not{nearest(name, names)}"
            )
    return tuple(m for i, m in enumerate(models) if i == 0 or m.name in settings.rivals)


def check_design(request: DesignRequest) -> None:
    """Refuse a request whose parts do not fit together, before any simulation.

    Raises
    ------
    ClusterEstError
        With advice on what to change.
    """
    problem = request.problem
    _check_comparable(problem)
    _check_variables(request, problem.describe())
    narrowed_labels(request)
    if request.targets:
        replace(problem, experiments=request.targets, constraints=()).describe()
    criterion = request.criterion
    if criterion.compares and len(request.models) < 2:
        raise ProblemError(
            f"criterion: {criterion.name!r} needs at least two models to distinguish, but the run "
            'has only one; choose "d" or "a", which reduce the uncertainty of its parameters, or '
            '"v"'
        )


def narrowed_labels(request: DesignRequest) -> tuple[str, ...]:
    """Return the labels of the first model's unknowns that count.

    By default, these are all unknowns that the next experiment shares with earlier ones.

    Raises
    ------
    ProblemError
        If a name is not an unknown of the run.
    """
    problem, settings = request.problem, request.settings
    unknowns = make_space(problem, problem.indices("train")).unknowns
    labels = tuple(unknown.label for unknown in unknowns)
    if not settings.parameters:
        groups = dict(request.like.groups)
        shared = tuple(unknown.label for unknown in unknowns if _is_shared(unknown, groups))
        if not shared:
            raise ProblemError(
                "parameters: a new experiment helps only parameters that it shares with other "
                "experiments, but each has its own value in every experiment; share at least one "
                "parameter"
            )
        return shared
    found: list[str] = []
    for name in settings.parameters:
        own = [u.label for u in unknowns if name in (u.label, u.parameter.name)]
        if not own:
            raise ProblemError(
                f"parameters: must be among the estimates of the run, but {name!r} is "
                f"not{nearest(name, labels)}"
            )
        found += own
    return tuple(dict.fromkeys(found))


def _is_shared(unknown: Unknown, groups: dict[str, str]) -> bool:
    """Return whether a new experiment in these groups has the same value."""
    per = unknown.parameter.per
    if per is None:
        return True
    return per.startswith("group:") and groups.get(per.removeprefix("group:")) == unknown.scope


def _check_comparable(problem: Problem) -> None:
    """Refuse a cost without weights, and residuals that are not differences of outputs."""
    if problem.cost.weights(np.zeros(1), np.zeros(1, np.int64)) is None:
        raise ProblemError(
            "design: needs a run whose cost has weights, such as sse, but the cost of this run is "
            f"{problem.cost.name}; fit again with sse and design from that run"
        )
    refuse_process_noise(problem, "design")
    for experiment in problem.experiments:
        if experiment.curve is not None or experiment.cost_function is not None:
            raise ProblemError(
                f"experiment {experiment.id!r}: must have only outputs at measured times for a "
                "design, but has a curve or a cost function; repeat the run without them"
            )
        for output in experiment.outputs:
            if not output.is_plain:
                raise ProblemError(
                    f"experiment {experiment.id!r}: for a design, output {output.variable} must be "
                    f"compared directly, but has {NOT_PLAIN}; repeat the run without it"
                )


def _check_variables(request: DesignRequest, description: ModelDescription) -> None:
    """Refuse names that do not exist, or of variables that cannot be chosen or limited."""
    limits, like, variables = request.limits, request.like, description.variables
    if not any(len(output.times) for output in like.outputs):
        raise ProblemError(
            f"like: experiment {like.id!r} must have measured outputs, but has none; choose "
            "another experiment"
        )
    known = [given.variable for given in like.inputs]
    for name in limits.inputs:
        _check_known(name, dotted("inputs", name), known, f"an input of experiment {like.id!r}")
        if variables[name].type == "Boolean":
            raise ProblemError(
                f"{dotted('inputs', name)}: a designed input must be a real number, but this input "
                'is true or false; leave it out to take it from the experiment of the key "like"'
            )
    for key, names in (("signals", limits.signals), ("start", limits.start)):
        for name in names:
            _check_known(name, f"{key}.{name}", variables, "a variable of the FMU")
    shared = {p.target for p in request.problem.parameters if p.per is None and not p.fixed}
    measured = {output.variable for output in like.outputs if len(output.times)}
    for name in limits.start:
        what = "an input" if name in known else "estimated" if name in shared else ""
        if not what and name in measured and name not in dict(like.values):
            what = "a measured output"
        if what:
            raise ProblemError(
                f"start.{name}: must be a start value that an experiment can choose, but is "
                f"{what}; name an initial state"
            )


def _check_known(name: str, where: str, known: Collection[str], what: str) -> None:
    if name not in known:
        raise ProblemError(f"{where}: must be {what}, but is not{nearest(name, known)}")
