import pytest
from support.described import fmi2
from support.problems.springs import FMU
from support.spoiled import GUID, LIBRARY, XML, rename, spoiled_fmu

from workers.errors import ModelError
from workers.fmu.description import describe, nearest
from workers.fmu.platforms import PLATFORM, PLATFORM_TUPLE, binary_path, platform_for
from workers.fmu.xml import BASE_UNITS, UnitDefinition


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
        (
            spoiled_fmu(lambda e: e.pop(XML)),
            "must contain a modelDescription.xml, but does not, so it",
        ),
        (spoiled_fmu(lambda e: e.clear()), "must contain a modelDescription.xml, but does not"),
        (spoiled_fmu(rename("", "model/")), "must contain a modelDescription.xml, but does not"),
        (replaced(b""), "its modelDescription.xml must be XML, but cannot be read (no element"),
        (
            replaced(b"fmi"),
            "its modelDescription.xml must be XML, but cannot be read (syntax error",
        ),
        (replaced(b"<a/>"), "must describe a model, with <fmiModelDescription>, but describes <a>"),
        (replaced(b'<fmiModelDescription fmiVersion="2.0">'), "must be XML, but cannot be read"),
        (replaced(BOMB), "must not declare entities, but does, which is not safe to read; remove"),
        (xml(VERSION, 'fmiVersion="1.0"'), "FMI version 2.0 or 3.0, but is of 1.0; export it in"),
        (xml(VERSION, 'fmiVersion="x"'), "FMI version 2.0 or 3.0, but is of x; export it in one"),
        (xml(VERSION, ""), "must be an FMU of FMI version 2.0 or 3.0, but names no version"),
        (xml(f'guid="{GUID}"', ""), "its modelDescription.xml must have a guid, but has none"),
        (
            xml(IDENTIFIER, ""),
            "but co-simulation has the modelIdentifier None, which is not a plain name; export it",
        ),
        (xml(IDENTIFIER, 'modelIdentifier="../x"'), "has the modelIdentifier '../x'"),
    ],
)
def test_a_bad_description_is_refused(content, sentence):
    with pytest.raises(ModelError) as error:
        describe("x.fmu", content)
    message = str(error.value)
    assert message.startswith("x.fmu: ")
    assert sentence in message
    assert "\n" not in message


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
        ("x", [], "; there are none to choose from"),
        ("qq", ["a", "b"], "; available: 'a', 'b'"),
        ("qq", [f"v{i}" for i in range(20)], "'v11' and 8 more"),
    ],
)
def test_the_nearest_name(name, known, sentence):
    assert nearest(name, known).endswith(sentence)


UNITS = """<UnitDefinitions>
<Unit name="rad/s"><BaseUnit s="-1" rad="1"/></Unit>
<Unit name="degC"><BaseUnit K="1" offset="273.15"/><DisplayUnit name="K"/></Unit>
<Unit name="bar"><BaseUnit kg="1" m="-1" s="-2" factor="1e5"/></Unit>
<Unit name="mystery"/>
<Unit name="V^0.5"><BaseUnit kg="0.5"/></Unit>
<Unit><BaseUnit m="1"/></Unit>
<Unit name="rad/s"><BaseUnit m="1"/></Unit>
</UnitDefinitions>"""


def powers(**given: int) -> tuple[int, ...]:
    return tuple(given.get(base, 0) for base in BASE_UNITS)


def test_definitions_are_read_and_names_alone_are_left_out():
    found = fmi2("", f"{UNITS}<ModelStructure/>")
    assert found.units == {
        "rad/s": UnitDefinition(powers(s=-1, rad=1)),
        "degC": UnitDefinition(powers(K=1), 273.15),
        "bar": UnitDefinition(powers(kg=1, m=-1, s=-2)),
    }
    (warning,) = found.warnings
    assert warning.endswith("powers that are not integers are used only as names: 'V^0.5'")
    assert fmi2("", "<ModelStructure/>").units == {}


def test_a_description_has_the_units_of_its_variables():
    description = describe(FMU.name, FMU.read_bytes())
    assert description.units[description.variables["v"].unit].powers == powers(m=1, s=-1)


HERE = binary_path("2.0", "m")


def test_a_binary_for_this_machine_is_enough():
    fmi2("", files=(HERE,)).check_platform("co_simulation")


def test_both_versions_name_this_machine_in_their_own_words():
    assert platform_for("2.0") == PLATFORM
    assert platform_for("3.0") == PLATFORM_TUPLE
    assert "-" in PLATFORM_TUPLE
    assert HERE.startswith(f"binaries/{PLATFORM}/m.")
    assert binary_path("3.0", "m").startswith(f"binaries/{PLATFORM_TUPLE}/m.")


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ((), f"but has none for any platform; export it for {PLATFORM}"),
        (("binaries/other/m.so",), f"but has one for other; export it for {PLATFORM}"),
        (
            ("binaries/linux32/m.so", "binaries/win32/m.dll"),
            "but has one for linux32, win32 (linux32 and win32: built for 32 bits, which a 64-bit "
            "program cannot load); export it for",
        ),
        (("sources/m.c",), "but has only sources; compile them, for example with the command"),
        (("sources/m.c", "binaries/other/m.so"), ", or compile its sources"),
        (
            (f"binaries/{PLATFORM}/n.so",),
            f"must have the binary {HERE}, but does not; export the FMU again",
        ),
    ],
)
def test_what_is_there_instead_is_named(files, sentence):
    with pytest.raises(ModelError) as error:
        fmi2("", files=files).check_platform("model_exchange")
    assert str(error.value).startswith("x.fmu: must have ")
    assert sentence in str(error.value)
