"""`value_files`: starts and known values from SSP parameter sets and tables."""

import pytest
from support.spoiled import REMOVED, write_input

from cluster_est import ClusterEstError, build_problem, read_config
from cluster_est.config.reader import parse_config
from cluster_est.errors import ConfigError

SSV = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
  version="1.0" name="found"><ssv:Parameters>{}</ssv:Parameters></ssv:ParameterSet>
"""
MASS = '<ssv:Parameter name="m"><ssv:Real value="1.75" unit="kg"/></ssv:Parameter>'
FRICTION = {"site": "der(v)", "form": "coulomb", "variables": ["v"]}


def read(folder, files, **changes):
    """A problem from a config beside files of values."""
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    config = read_config(write_input(folder, {"value_files": [*files], **changes}))
    return config, build_problem(config, folder)


def starts(problem):
    return {p.name: p.start for p in problem.parameters}


def test_a_parameter_set_gives_starts_and_known_values(tmp_path):
    known = '<ssv:Parameter name="c"><ssv:Real value="0.4"/></ssv:Parameter>'
    config, problem = read(tmp_path, {"found.ssv": SSV.format(MASS + known)}, values=REMOVED)
    assert starts(problem)["m"] == 1.75
    assert config.values["c"] == 0.4
    assert dict(problem.experiments[0].values)["c"] == 0.4
    resolved = config.model_dump()  # a run has the numbers themselves
    assert "value_files" not in resolved
    assert resolved["parameters"]["m"]["start"] == 1.75


def test_a_table_does_the_same_and_the_later_file_counts(tmp_path):
    table = "name;value;unit;who\nm;1.5;kg;me\nk;20;;\n"
    _, problem = read(tmp_path, {"a.ssv": SSV.format(MASS), "b.csv": table})
    assert starts(problem)["m"] == 1.5
    assert starts(problem)["k"] == 20.0


def test_a_coefficient_is_named_by_its_effect(tmp_path):
    files = {"set.csv": "name,value\ncoulomb.k,0.7\ncoulomb.width,0.01\n"}
    _, problem = read(tmp_path, files, effects=[FRICTION])
    assert starts(problem)["coulomb.k"] == 0.7
    assert starts(problem)["coulomb.width"] == 0.01


def test_a_known_value_of_the_config_wins(tmp_path):
    files = {"set.csv": "name,value\nc,0.4\n"}
    config, _ = read(tmp_path, files, values={"c": 0.9})
    assert config.values == {"c": 0.9}


@pytest.mark.parametrize(
    ("name", "text", "pattern"),
    [
        ("set.csv", "name,value,unit\nm,1750,g\n", "m must be in 'kg'.*, but is in 'g'"),
        ("set.csv", "nam,value\nm,1\n", "columns name and value, but has nam, value"),
        (
            "set.csv",
            "name;value\nm;1,5\n",
            "set.csv: m is estimated, .* must be a number",
        ),
        ("set.csv", "name,value\nzz,1\n", "'zz'"),
        ("set.csv", "name,value\nm,-5\n", "parameters.m.start: must lie within the bounds"),
        ("a.ssv", "<a/>", "a.ssv must be a parameter set of SSP 1.0, but is not"),
        ("a.ssv", SSV.format("<b/>"), "a.ssv must be a parameter set of SSP 1.0, but is not"),
        ("a.txt", "m 1", "a.txt must end in .ssv or .csv"),
    ],
)
def test_mistakes(tmp_path, name, text, pattern):
    with pytest.raises(ClusterEstError, match=pattern):
        read(tmp_path, {name: text})


@pytest.mark.parametrize(
    ("listed", "pattern"),
    [
        (["no.ssv"], r"value_files: there is no file .*no\.ssv; check the name"),
        ("a.ssv", r'value_files: must be a list of files, like \["values\.ssv"\]'),
    ],
)
def test_a_list_of_files_that_is_wrong(tmp_path, listed, pattern):
    with pytest.raises(ConfigError, match=pattern):
        read_config(write_input(tmp_path, {"value_files": listed}))


def test_a_config_in_memory_has_no_folder():
    with pytest.raises(ConfigError, match="is only possible in a config file"):
        parse_config({"value_files": ["a.ssv"]}, "here")


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"parameters.m": 3.0}, "parameters.m: .*a table.*3.0"),
        ({"values": 3.0}, "values: .*a table.*3.0"),
        ({"effects": 3.0}, "effects: .*a list"),
    ],
)
def test_what_is_no_table_is_refused_as_without_a_file(tmp_path, changes, pattern):
    files = {"set.csv": "name,value\nm,1.5\nzz,2\n"}
    with pytest.raises(ConfigError, match=pattern):
        read(tmp_path, files, **changes)
