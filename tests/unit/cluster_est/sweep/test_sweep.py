from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import ROOT
from support.spoiled import valid_tree, write_input

from cluster_est import Solver, build_problem
from cluster_est.errors import ConfigError
from cluster_est.running.environment import Monitor, RunEnvironment, SharedPools
from cluster_est.running.resources import Resources
from cluster_est.sweep.matrix import read_sweep
from cluster_est.toml import to_toml
from workers.messages import Limits, Task

METHODS = {
    "name": "method",
    "values": {"ls": {"method.name": "least_squares"}, "pattern": {"method.name": "sqp"}},
}
SEEDS = {"name": "seed", "key": "method.seed", "values": [0, 1]}


def write_sweep(folder, **keys):
    path = folder / "sweep.toml"
    path.write_text(to_toml({"configs": ["config.toml"], **keys}), encoding="utf-8")
    return path


def names(folder, **keys):
    return [run.name for run in read_sweep(write_sweep(folder, **keys))]


def three_experiments(folder):
    tree = valid_tree()
    tree["experiments"] = [tree["experiments"][0] | {"id": name} for name in "abc"]
    write_input(folder, {"experiments": tree["experiments"]})


def problem_of(folder, ids):
    (run,) = read_sweep(write_sweep(folder, overrides={"only_experiments": ids}))
    return build_problem(run.read(), folder)


def test_every_combination_is_a_run_unless_it_is_left_out(tmp_path):
    expected = [f"config-{method}-seed_{seed}" for method in ("ls", "pattern") for seed in (0, 1)]
    assert names(tmp_path, axes=[METHODS, SEEDS]) == expected
    kept = names(tmp_path, axes=[METHODS, SEEDS], skip=[{"method": "ls", "seed": [1]}])
    assert kept == [expected[0], *expected[2:]]


def test_a_sweep_without_axes_runs_each_config(tmp_path):
    assert names(tmp_path, configs=["a.toml", "b/c.toml"]) == ["a", "c"]
    assert names(tmp_path, configs={"x": "a/config.toml", "y": "b/config.toml"}) == ["x", "y"]


def test_every_run_of_the_example_is_read():
    runs = read_sweep(ROOT / "configs" / "sweep.toml")
    assert len(runs) == 10
    methods = {run.choices.get("method", ""): run.read().method.name for run in runs}
    assert methods == {"": "least_squares", "least_squares": "least_squares", "sqp": "sqp"}


def test_overrides_are_put_in_from_the_general_to_the_particular(tmp_path):
    write_input(tmp_path)
    axes = [{"name": "end", "values": {"x": {"method.seed": 2, "budget.seconds": 9.0}}}]
    single = {"name": "single", "overrides": {"budget.evaluations": 7}}
    general = {"method.seed": 1, "parameters.m.start": 3.5}
    first, second = read_sweep(write_sweep(tmp_path, overrides=general, axes=axes, runs=[single]))
    one, other = first.read(), second.read()
    assert (one.method.seed, one.parameters["m"].start, one.budget.seconds) == (2, 3.5, 9.0)
    assert (other.method.seed, other.budget.evaluations) == (1, 7)
    assert first.choices == {"config": "config", "end": "x"}


@pytest.mark.parametrize(
    ("overrides", "kept"),
    [
        ({"only_experiments": ["c", "a"]}, ["a", "c"]),
        ({"drop_experiments": ["b"]}, ["a", "c"]),
        ({"only_experiments": ["a", "b"], "drop_experiments": ["b"]}, ["a"]),
    ],
)
def test_subsets_of_experiments(tmp_path, overrides, kept):
    three_experiments(tmp_path)
    (run,) = read_sweep(write_sweep(tmp_path, overrides=overrides))
    assert [experiment.id for experiment in run.read().experiments] == kept


@pytest.mark.parametrize(
    ("overrides", "phrase"),
    [
        ({"only_experiments": ["a", "bb"]}, "there is no experiment 'bb'; did you mean 'b'?"),
        (
            {"drop_experiments": ["a", "b", "c"]},
            "must leave at least one experiment, but leaves none",
        ),
        ({"parameters.m.stat": 1.0}, "unknown key parameters.m.stat; did you mean 'start'?"),
    ],
)
def test_wrong_overrides_are_refused(tmp_path, overrides, phrase):
    three_experiments(tmp_path)
    (run,) = read_sweep(write_sweep(tmp_path, overrides=overrides))
    with pytest.raises(ConfigError) as caught:
        run.read()
    assert phrase in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "phrase"),
    [
        ({"axis": []}, "unknown key axis; did you mean 'axes'?"),
        ({"configs": []}, "configs: must have at least one entry"),
        ({"configs": ["a/x.toml", "b/x.toml"]}, "files with different names"),
        ({"configs": {"a b": "x.toml"}}, "configs.a b: the name must consist of letters"),
        ({"axes": [SEEDS | {"values": [0, 0]}]}, "a list of different plain values"),
        ({"axes": [SEEDS | {"values": [[0]]}]}, "a list of different plain values"),
        ({"axes": [{"name": "seed", "values": [0]}]}, "because its axis has no key"),
        ({"axes": [SEEDS, SEEDS]}, "axes.seed: the name must be used only once"),
        ({"axes": [SEEDS | {"name": "config"}]}, "axes.config: the name must be used only once"),
        ({"axes": [SEEDS | {"values": [*range(10_001)]}]}, "at most 10000 runs, but make 10001"),
        ({"overrides": {"method": {"seed": 1}}}, 'must be in quotes; write "method.seed" = '),
        ({"overrides": {"only_experiments": "a"}}, "must be a list of ids of experiments"),
        (
            {"axes": [SEEDS], "skip": [{"sed": 1}]},
            "skip[0].sed: there is no axis of that name; did you",
        ),
        ({"axes": [SEEDS], "skip": [{"seed": 7}]}, "skip[0].seed: the axis has no value '7'"),
        (
            {"axes": [SEEDS], "skip": [{"seed": [0, 1]}]},
            "must leave at least one run, but leaves none",
        ),
        ({"runs": [{"name": "Config"}]}, "two runs must not have the same name, but config has it"),
        ({"runs": [{"name": "sweep.json"}]}, "a file of the sweep has this name"),
        ({"runs": [{"name": "../x"}]}, "the name must consist of letters"),
        ({"runs": [{"name": "x", "config": "confg"}]}, "no 'confg'; did you mean 'config'?"),
        ({"configs": ["a", "b"], "runs": [{"name": "x"}]}, "because there are several configs"),
    ],
)
def test_wrong_sweeps_are_refused(tmp_path, keys, phrase):
    with pytest.raises(ConfigError) as caught:
        read_sweep(write_sweep(tmp_path, **keys))
    assert phrase in str(caught.value)
    assert str(tmp_path / "sweep.toml") in str(caught.value)


def test_a_missing_or_broken_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"there is no sweep file .*sweep\.toml"):
        read_sweep(tmp_path / "sweep.toml")
    (tmp_path / "sweep.toml").write_bytes(b"\xff\xfe = [")
    with pytest.raises(ConfigError, match=r"sweep\.toml: must be text in UTF-8"):
        read_sweep(tmp_path / "sweep.toml")
    (tmp_path / "sweep.toml").write_bytes(b"configs = [")
    with pytest.raises(ConfigError, match=r"sweep\.toml: must be TOML, but is not"):
        read_sweep(tmp_path / "sweep.toml")


def leased(pools, problem, resources=None):
    """The workers that a run is given."""
    with pools.lease(problem, resources or Resources(), None) as (pool, _):
        return pool


def test_workers_stay_for_the_same_experiments(tmp_path):
    three_experiments(tmp_path)
    opened = [problem_of(tmp_path, ids) for ids in (["a", "b"], ["a", "b"], ["a"])]
    with SharedPools() as pools:
        first = leased(pools, opened[0])
        assert leased(pools, opened[1]) is first
        assert leased(pools, opened[2]) is not first


def test_runs_with_other_start_values_do_not_make_an_fmu_unrepeatable(tmp_path):
    write_input(tmp_path)
    problem, said = problem_of(tmp_path, ["a"]), []
    first, *rest = problem.parameters
    elsewhere = replace(problem, parameters=(replace(first, start=1.7 * first.start), *rest))
    with SharedPools() as pools:
        of = RunEnvironment(monitor=Monitor(reset=said.append), source=pools)
        for each in (problem, elsewhere):
            with of.executor(each):
                pass
    assert len(said) == 2  # each run is told the decision once: no comparison has changed it
    assert said[0].plain
    assert said[1] == said[0]


@pytest.mark.parametrize(
    "other",
    [
        {"model": {"solver": Solver("rk4")}},
        {"model": {"reset": "instance"}},
        {"resources": {"limits": Limits(seconds=1.0)}},
        {"resources": {"workers": 2}},
    ],
)
def test_workers_do_not_stay_for_a_run_that_asks_for_others(tmp_path, other):
    write_input(tmp_path)
    problem = problem_of(tmp_path, ["a"])
    changed = replace(problem, model=replace(problem.model, **other.get("model", {})))
    with SharedPools() as pools:
        first = leased(pools, problem)
        assert leased(pools, changed, Resources(**other.get("resources", {}))) is not first


def test_workers_with_work_left_are_replaced(tmp_path):
    write_input(tmp_path)
    problem = problem_of(tmp_path, ["a"])
    with SharedPools() as pools:
        first = leased(pools, problem)
        first.submit([Task(0, 0, np.array([1.0, 25.0]))])
        second = leased(pools, problem)
        assert second is not first
        assert not second.busy
