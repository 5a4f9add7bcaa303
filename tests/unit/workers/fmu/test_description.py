"""Model descriptions that are not what they should be."""

import pytest
from support.spoiled import GUID, LIBRARY, XML, rename, spoiled_fmu

from workers.errors import ModelError
from workers.fmu.description import describe, nearest


def replaced(content: bytes) -> bytes:
    return spoiled_fmu(lambda entries: entries.update({XML: content}))


def xml(old: str, new: str) -> bytes:
    return spoiled_fmu(xml={old: new})


BOMB = b"<!DOCTYPE a [<!ENTITY b 'b'><!ENTITY c '&b;&b;'>]><a>&c;</a>"
VERSION = 'fmiVersion="2.0"'
IDENTIFIER = 'modelIdentifier="mass_spring_damper"'


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (spoiled_fmu(lambda e: e.pop(XML)), "must hold a modelDescription.xml but does not, so it"),
        (spoiled_fmu(lambda e: e.clear()), "must hold a modelDescription.xml but does not"),
        (spoiled_fmu(rename("", "model/")), "must hold a modelDescription.xml but does not"),
        (replaced(b""), "its modelDescription.xml must be XML but cannot be read (no element"),
        (replaced(b"fmi"), "its modelDescription.xml must be XML but cannot be read (syntax error"),
        (replaced(b"<a/>"), "must describe a model, as <fmiModelDescription>, but describes <a>"),
        (replaced(b'<fmiModelDescription fmiVersion="2.0">'), "must be XML but cannot be read"),
        (replaced(BOMB), "must not declare entities but does, which is not safe to read; remove"),
        (xml(VERSION, 'fmiVersion="1.0"'), "FMI version 2.0 or 3.0 but is of 1.0; export it as"),
        (xml(VERSION, 'fmiVersion="x"'), "FMI version 2.0 or 3.0 but is of x; export it as one"),
        (xml(VERSION, ""), "must be an FMU of FMI version 2.0 or 3.0 but names no version"),
        (xml(f'guid="{GUID}"', ""), "its modelDescription.xml must have a guid but has none"),
        (xml(IDENTIFIER, ""), "but co-simulation has None for a plain modelIdentifier; export it"),
        (xml(IDENTIFIER, 'modelIdentifier="../x"'), "has '../x' for a plain modelIdentifier"),
    ],
)
def test_a_bad_description_is_refused(content, sentence):
    with pytest.raises(ModelError) as error:
        describe("x.fmu", content)
    message = str(error.value)
    assert message.startswith("x.fmu: ")
    assert sentence in message
    assert "\n" not in message


@pytest.mark.parametrize("nominal", ["NaN", "INF", "0", "much"])
def test_a_nominal_value_that_is_none_counts_as_one(nominal):
    content = xml('nominal="0.1"', f'nominal="{nominal}"')
    assert describe("x.fmu", content).variables["x"].nominal == 1.0


@pytest.mark.parametrize(
    ("attributes", "settable"),
    [
        ('causality="parameter" variability="fixed"', True),
        ('causality="calculatedParameter" variability="fixed"', False),
        ('causality="input" variability="continuous"', True),
        ('causality="local" variability="constant"', False),
        ('causality="local" initial="exact"', True),
        ('causality="local" initial="approx"', True),
        ('causality="output" initial="calculated"', False),
        ('causality="local"', True),
    ],
)
def test_what_can_be_set(attributes, settable):
    variable = f'<ScalarVariable name="new" valueReference="99" {attributes}><Real start="1"/>'
    content = xml("</ModelVariables>", f"{variable}</ScalarVariable></ModelVariables>")
    assert describe("x.fmu", content).variables["new"].settable is settable


def test_platforms_are_those_that_have_a_binary():
    assert describe("x.fmu", spoiled_fmu()).platforms == ("darwin64", "linux64", "win64")
    bare = spoiled_fmu(lambda entries: entries.pop(LIBRARY))
    assert describe("x.fmu", bare).platforms == ("darwin64", "win64")


@pytest.mark.parametrize(
    ("name", "known", "sentence"),
    [
        ("Mas", ["mass", "k"], "; did you mean 'mass'?"),
        ("x", [], "; it has none at all"),
        ("qq", ["a", "b"], "; it has 'a', 'b'"),
        ("qq", [f"v{i}" for i in range(20)], "'v11' and 8 more"),
    ],
)
def test_the_nearest_name(name, known, sentence):
    assert nearest(name, known).endswith(sentence)
