import re
import shlex
import tomllib
from pathlib import Path

import pytest
from support.run_folders import SPRING

from cluster_est.cli import main
from cluster_est.cli.criterion import Criterion
from cluster_est.cli.entry_point import COMMANDS
from cluster_est.cli.forms_command import EVERY_FORM, SITES, config_block
from cluster_est.cli.parent_process import ExitCode
from cluster_est.cli.parser import CODES_IN_WORDS, EXAMPLES, FIRST_EXAMPLES, UsageError, parse
from cluster_est.config.config_text import unfilled
from cluster_est.config.reader import read_config
from cluster_est.config.sections import EffectSection
from cluster_est.problem.declared_effects import DeclaredCoefficient, DeclaredEffect, make_effect
from workers.effects.kinds import GridScale


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_examples_that_can_be_given(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        parse([command, "--help"])
    shown = capsys.readouterr().out
    for example in EXAMPLES[command]:
        assert f"\n  cluster-est {example}\n" in shown
        options = parse(shlex.split(example))
        assert options.command in (command, "show")
        assert all(Criterion(each, options.command) for each in options.fail_if)
        read_config(Path(SPRING), getattr(options, "overrides", []))  # keys that there are
    assert any(example.split()[0] == command for example in EXAMPLES[command])


def test_the_help_of_the_program_has_examples_and_every_exit_code(capsys):
    with pytest.raises(SystemExit, match="0"):
        parse(["--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert all(f"cluster-est {example}" in shown for example in FIRST_EXAMPLES)
    assert f"Exit codes: {CODES_IN_WORDS}." in shown
    assert {int(each) for each in re.findall(r"(\d+) ", CODES_IN_WORDS)} == set(ExitCode)


def test_an_option_that_is_none_is_refused():
    with pytest.raises(UsageError, match="unrecognized argument: --jsn"):
        parse(["show", "runs/first", "--jsn"])


ARGUMENTS = {"derivative": "der(v)", "pair": "pair v,w", "input": "input u", "output": "output y",
             "parameter": "parameter k"}  # fmt: skip


@pytest.mark.parametrize(("kind", "name"), EVERY_FORM)
def test_the_block_of_a_form_is_an_effect_once_it_is_filled_in(kind, name):
    form = EVERY_FORM[kind, name]
    text = config_block(kind, form)
    tree = tomllib.loads(text)
    open_ = list(unfilled(tree, text, "first.toml"))
    assert sum(SITES[kind][0] in line for line in open_) == 1
    (own,) = tree["effects"]
    own["site"] = ARGUMENTS[kind]
    own["variables"] = ["v", "w"][: form.variables]
    for coefficient in form.coefficients:
        given = own["parameters"][coefficient.name]
        if isinstance(given["start"], str):
            given["start"] = 1.0
        assert given.get("fixed", False) is coefficient.held
    section = EffectSection.model_validate(own)
    declared = DeclaredEffect(
        section.name,
        section.site,
        section.form,
        variables=tuple(section.variables),
        coefficients={
            name: DeclaredCoefficient(start=each.start, fixed=each.fixed)
            for name, each in section.parameters.items()
        },
    )
    made = make_effect(declared)
    assert len(made.parameters) == len(form.coefficients)


WITHOUT_SCALE = (GridScale.EXPONENT, GridScale.NUMBER, GridScale.DAMPING)
"""Their entries are the values themselves."""


def test_every_size_that_is_to_be_filled_in_says_where_to_begin():
    for (kind, _), form in EVERY_FORM.items():
        for each in form.coefficients:
            if each.scale not in (None, *WITHOUT_SCALE):
                assert f"x {each.scale.value}" in config_block(kind, form)


@pytest.mark.parametrize(
    ("word", "found", "absent"),
    [
        ("friction", {"coulomb", "stribeck", "dahl"}, {"radiation", "drift"}),
        ("Hysteresis", {"dahl", "hysteresis"}, {"coulomb", "backlash"}),
        ("lag", {"lag"}, {"coulomb"}),  # a form of this name is described
    ],
)
def test_forms_are_found_by_a_word_of_their_description(word, found, absent, capsys):
    assert main(["forms", word]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = {line.split(maxsplit=1)[0] for line in lines if line and not line.startswith(" ")}
    assert found <= first
    assert not absent & first
    assert any(line == "[[effects]]" for line in lines) is (word == "lag")


def test_a_misspelt_word_is_compared_with_names_and_families(capsys):
    assert main(["forms", "frcition"]) == 2
    assert "did you mean 'friction'?" in capsys.readouterr().err


@pytest.mark.parametrize("width", [90, 140])
def test_the_list_of_forms_fits_the_terminal(width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["forms", "--site", "derivative"]) == 0
    out = capsys.readouterr().out
    table = out[out.index("form ") : out.index("In the equations")].splitlines()
    assert max(map(len, table)) <= width
    named = {line.split()[0] for line in table if line[:1].strip()}
    assert {name for kind, name in EVERY_FORM if kind == "derivative"} <= named
