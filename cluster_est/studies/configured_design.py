"""Makes the design of an experiment from a run's folder and a file of limits."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cluster_est.config.build import build_problem
from cluster_est.config.limits_file import read_limits, with_named_targets
from cluster_est.config.reader import original_config, read_config
from cluster_est.config.sections import Config, EffectSection
from cluster_est.errors import ConfigError, RunFolderError
from cluster_est.experiment_design.design import Design
from cluster_est.experiment_design.models import CandidateModel
from cluster_est.experiment_design.request import (
    FITTED_MODEL,
    DesignRequest,
    chosen_models,
)
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.problem.problem import Problem
from cluster_est.run_folder.logged_simulation import config_base
from cluster_est.run_folder.run_files import (
    check_has_estimates,
    read_config_text,
    read_facts,
    read_run_table,
)
from cluster_est.run_folder.run_identity import UNHASHED, RunIdentity, RunKind
from cluster_est.studies.configured import ConfiguredStudy, thinned_for
from workers.messages import Experiment, content_hash

ADDED = ("found", "partial")
"""Verdicts of a closed loop that has added effects."""


def read_design(
    run_folder: Path,
    limits: Path,
    config: Path | None,
    overrides: Sequence[str] = (),
    predict: Sequence[str] = (),
    *,
    allow_code: bool,
) -> ConfiguredStudy:
    """Read a run and the limits of the next experiment, and check that they are consistent.

    Parameters
    ----------
    run_folder
        Folder of a finished fit or closed loop.
    limits
        The file of limits.
    config
        The config of the run, if it has been moved.
    overrides
        "key=value" for the executor, the budget and the log.
    predict
        "EXPERIMENT" or "EXPERIMENT:OUTPUT,OUTPUT": predicted quantities, instead of those in the
        file.
    allow_code
        Whether Python functions that are named in the config may run.

    Raises
    ------
    ClusterEstError
        If something is missing or inconsistent.
    """
    wanted = read_limits(limits)
    facts = read_facts(run_folder)
    check_has_estimates(run_folder)
    for given in overrides:
        if given.partition(".")[0] not in UNHASHED:
            raise ConfigError(
                f"{given}: must be a key of {', '.join(UNHASHED)}, but is not; leave it out, "
                "because a design takes all other keys from the run"
            )
    config_text = read_config_text(run_folder)
    resolved = read_config(run_folder / "config.toml", overrides)
    base = config_base(run_folder, config)
    models = _models(run_folder, facts, resolved, base, allow_code=allow_code)
    ids = [experiment.id for experiment in models[0].problem.experiments]
    settings = with_named_targets(wanted.settings, predict, ids)
    models = chosen_models(models, settings)
    request = DesignRequest(models, wanted.limits, settings, wanted.seed)
    study = Design(request)
    study.check()
    parts = [str(facts["config_hash"]), wanted.text, json.dumps([m.name for m in models])]
    parts += [json.dumps({k: float(v) for k, v in m.values.items()}) for m in models]
    parts += [json.dumps(list(predict))] if predict else []
    parts += [part for target in settings.predictions for part in _planned(target)]
    identity = RunIdentity(
        RunKind.DESIGN,
        request.problem,
        config_text,
        content_hash(list(parts)),
        wanted.seed,
        base,
        resolved.log,
        original_config(run_folder / "config.toml") if config is None else config,
    )
    return ConfiguredStudy(identity, resolved, study)


def _planned(target: PredictionTarget) -> list[str]:
    """Return texts that identify a planned experiment, whose table is not in the limits file."""
    if isinstance(target.experiment, str):
        return []
    return [json.dumps([g.times.tolist(), g.values.tolist()]) for g in target.experiment.inputs]


def _models(
    run_folder: Path,
    facts: Mapping[str, Any],
    config: Config,
    base: Path,
    *,
    allow_code: bool,
) -> tuple[CandidateModel, ...]:
    """Return the models that are compatible with a run; the chosen model is the first."""
    if facts.get("verdict") in ADDED:
        return tuple(
            _model(each, config, base, facts, allow_code=allow_code) for each in facts["competing"]
        )
    path = run_folder / "parameters.parquet"
    if not path.is_file():
        raise RunFolderError(
            f"{run_folder}: must be the folder of a finished run, but is not; "
            "finish the run with --resume"
        )
    rows = [row for row in read_run_table(path) if row["estimated_on"] in ("train", "test")]
    values = {row["label"]: float(row["value"]) for row in rows}
    problem = _rows_for_design(build_problem(config, base, allow_code=allow_code), config)
    return (CandidateModel(FITTED_MODEL, _with_noise(problem, facts), values),)


def _model(
    known: Mapping[str, Any],
    config: Config,
    base: Path,
    facts: Mapping[str, Any],
    *,
    allow_code: bool,
) -> CandidateModel:
    """Return one of the models of a closed loop, from its entry in run.json."""
    blocks = tomllib.loads(known["config"]).get("effects", [])
    added = [EffectSection.model_validate(block) for block in blocks]
    changed = config.model_copy(update={"effects": [*config.effects, *added]})
    problem = _rows_for_design(build_problem(changed, base, allow_code=allow_code), config)
    values = {label: float(value) for label, value in known["values"].items()}
    return CandidateModel(known["name"], _with_noise(problem, facts), values, known["weight"])


def _rows_for_design(problem: Problem, config: Config) -> Problem:
    """Return the problem with thinned records, which give the same information on parameters."""
    return thinned_for(RunKind.DESIGN, config, problem).problem


def _with_noise(problem: Problem, facts: Mapping[str, Any]) -> Problem:
    """Return the problem with the noise estimated by a closed loop, for outputs without a sigma."""
    noise: Mapping[str, float] = facts.get("noise") or {}
    return replace(problem, experiments=tuple(_weighted(e, noise) for e in problem.experiments))


def _weighted(experiment: Experiment, noise: Mapping[str, float]) -> Experiment:
    outputs: Sequence[Any] = [
        replace(output, sigma=float(noise[output.variable]), relative_sigma=0.0, sigma_known=True)
        if not output.has_sigma and (noise.get(output.variable) or 0.0) > 0.0
        else output
        for output in experiment.outputs
    ]
    return replace(experiment, outputs=tuple(outputs))
