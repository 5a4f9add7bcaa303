"""`model.units`: names for tables and words, which change no number."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.springs import FMU
from support.spoiled import write_input

from cluster_est import build_problem, read_config
from cluster_est.errors import ProblemError
from cluster_est.run_folder.run_identity import RunIdentity, RunKind


def built(folder, **changes):
    config = read_config(write_input(folder, changes))
    return config, build_problem(config, folder)


def test_units_take_the_place_of_the_fmus(tmp_path):
    _, plain = built(tmp_path)
    _, problem = built(tmp_path, **{"model.units": {"v": "km/h"}})
    assert plain.describe().variables["v"].unit == "m/s"
    described = problem.describe()
    assert described.variables["v"].unit == "km/h"
    assert described.variables["x"].unit == "m"
    assert FMU.name == described.file


def test_a_name_that_nothing_has_is_refused(tmp_path):
    with pytest.raises(ProblemError, match=r"model\.units\.vv: .* no variable and no experiment"):
        built(tmp_path, **{"model.units": {"vv": "m/s"}})


def test_a_signal_may_have_a_unit(tmp_path):
    changes = {"model.units": {"wind": "m/s"}, "experiments.0.signals": {"wind": "force"}}
    _, problem = built(tmp_path, **changes)
    assert dict(problem.units) == {"wind": "m/s"}


def test_units_leave_a_run_what_it_was(tmp_path):
    hashes = set()
    for units in ({}, {"v": "km/h"}):
        config, problem = built(tmp_path, **{"model.units": units})
        hashes.add(RunIdentity.of(RunKind.FIT, config, tmp_path, problem).config_hash)
    assert len(hashes) == 1


def test_a_problem_knows_its_tables_and_what_of_them_is_used(tmp_path):
    _, problem = built(tmp_path)
    source = problem.tables[0]
    assert source.experiment == problem.experiments[0].id
    assert {"force", "position"} <= set(source.used)
    unused = source.unused()
    assert not set(unused.values) & set(source.used)


def test_unused_columns_of_a_file_are_read_with_their_times(tmp_path):
    _, problem = built(tmp_path)
    source = problem.tables[0]
    lines = source.path.read_text().splitlines()
    wider = [f"{lines[0]},extra,words"]
    wider += [f"{line},{i * i},ab" for i, line in enumerate(lines[1:])]
    source.path.write_text("\n".join(wider) + "\n")
    unused = source.unused()
    assert list(unused.values) == ["extra"]
    assert unused.values["extra"].tolist() == [i * i for i in range(len(lines) - 1)]
    middle = 0.5 * (unused.times[:-1] + unused.times[1:])
    there = unused.at("extra", middle)
    squares = np.arange(len(lines) - 1) ** 2
    assert there == pytest.approx(0.5 * (squares[:-1] + squares[1:]))
    assert unused.at("extra", unused.times + 1e6) is None
