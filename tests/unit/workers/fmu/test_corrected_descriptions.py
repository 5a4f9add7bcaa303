"""Descriptions with faults that do no harm load, with a sentence for each thing read around."""

import codecs
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.described import BOTH, END, HEAD_2, fmi2, packed, read
from support.spoiled import spoiled_fmu

from workers.errors import ModelError
from workers.fmu.description import describe


def real(name: str, reference: str | int, attributes: str = "", value: str = "") -> str:
    own = f'name="{name}" valueReference="{reference}" {attributes}'
    return f"<ScalarVariable {own}><Real {value}/></ScalarVariable>"


EMPTY = "<ModelStructure/>"
SPRING = (
    real("x", 1, value='start="1"')
    + real("v", 2)
    + real("der(x)", 3, value='derivative="1"')
    + real("der(v)", 4, value='derivative="2"')
)


def derivatives(*indices: object) -> str:
    unknowns = "".join(f'<Unknown index="{i}"/>' for i in indices)
    return f"<ModelStructure><Derivatives>{unknowns}</Derivatives></ModelStructure>"


@pytest.mark.parametrize(
    ("variables", "sentence", "left"),
    [
        (real("a", 1, 'causality="odd"'), "attributes causality, which FMI does not know", ["a"]),
        (real("a", 1, 'variability="odd"'), "attributes variability, which FMI does not", ["a"]),
        (real("a", 1, 'initial="odd"'), "attributes initial, which FMI does not know", ["a"]),
        (real("a", 1, value='declaredType="T"'), "types that are not declared anywhere are", ["a"]),
        (real("a", 1, value='start="1,0"'), "attributes start that are not numbers are", ["a"]),
        (real("a", 1, value='min="1_0"'), "attributes min that are not numbers are ignored", ["a"]),
        (
            real("a", 1, value='min="2" max="1"'),
            "min and max are ignored if min is above max",
            ["a"],
        ),
        (real("a", 1, value='nominal="0"'), "a nominal value that is 0 or not a number", ["a"]),
        (real("a", 1, value='nominal="INF"'), "a nominal value that is 0 or not a number", ["a"]),
        (real("a", 1, value='derivative="7"'), "attributes derivative are ignored", ["a"]),
        (real("a", "x"), "variables without a valueReference of at most 32 bits are left out", []),
        (
            real("a", 2**32),
            "variables without a valueReference of at most 32 bits are left out",
            [],
        ),
        (real("", 1), "variables without a name are left out: 'variable 1'", []),
        ('<ScalarVariable name="a" valueReference="1"/>', "variables whose type FMI", []),
        (real("a", 1) + real("a", 2), "a name that occurs twice refers to the first", ["a"]),
    ],
)
def test_a_variable_with_a_fault(variables, sentence, left):
    found = fmi2(variables + real("b", 9, value='start="3"'), EMPTY)
    assert list(found.variables) == [*left, "b"]
    assert found.variables["b"].start == 3.0
    (warning,) = found.warnings
    assert warning.startswith(f"x.fmu: {sentence}")
    for name in left:
        variable = found.variables[name]
        assert variable.causality == "local"
        assert variable.start is variable.low is variable.high is variable.derivative_of is None
        assert (variable.reference, variable.nominal) == (1, 1.0)


def test_the_same_fault_on_many_variables_is_one_sentence():
    found = fmi2("".join(real(f"a{i}", i, 'initial="odd"') for i in range(9)), EMPTY)
    (warning,) = found.warnings
    assert warning.endswith("are ignored: 'a0', 'a1', 'a2' and 6 more")


@pytest.mark.parametrize(
    "variables",
    [
        real("a", 1, 'odd="1" xsi:odd="2"', 'unit="no such unit" odd="3"'),
        "<Odd/>" + real("a", 1) + "<!-- a comment -->",
        '<ScalarVariable name="a" valueReference="1"><Annotations/><Real/></ScalarVariable>',
        real("a", 1, 'causality="parameter" variability="continuous" initial="calculated"'),
        real("a", 1, 'causality="output" variability="constant" initial="approx"'),
    ],
)
def test_what_FMI_does_not_know_is_passed_over(variables):  # noqa: N802
    found = fmi2(variables, EMPTY + "<Odd><Odd/></Odd>")
    assert list(found.variables) == ["a"]
    assert found.warnings == ()


def test_the_order_of_the_sections_does_not_matter():
    found = read(
        f"{HEAD_2}{derivatives(3, 4)}<ModelVariables>{SPRING}</ModelVariables>"
        f"<TypeDefinitions/>{BOTH}{END}"
    )
    assert (found.states, found.warnings) == (("x", "v"), ())


def test_positions_count_variables_that_are_left_out():
    found = fmi2(real("", 9) + real("x", 1) + real("der(x)", 3, value='derivative="2"'),
                 derivatives(3))  # fmt: skip
    assert found.states == ("x",)


def test_a_type_gives_what_the_variable_does_not():
    found = read(
        f'{HEAD_2}{BOTH}<TypeDefinitions><SimpleType name="T"><Real unit="K" min="1" max="2"'
        f' nominal="3" odd="4"/></SimpleType></TypeDefinitions><ModelVariables>'
        f"{real('a', 1, value='declaredType=' + chr(34) + 'T' + chr(34) + ' max=' + repr('9'))}"
        f"</ModelVariables>{EMPTY}{END}"
    ).variables["a"]
    assert (found.unit, found.low, found.high, found.nominal) == ("K", 1.0, 9.0, 3.0)


def test_types_of_fmi_2_in_the_names_of_fmi_3():
    types = {"Real": "Float64", "Integer": "Int32", "Enumeration": "Int32", "Boolean": "Boolean",
             "String": "String"}  # fmt: skip
    found = fmi2("".join(f'<ScalarVariable name="{t}" valueReference="1"><{t}/></ScalarVariable>'
                         for t in types), EMPTY)  # fmt: skip
    assert {v.name: v.type for v in found.variables.values()} == types
    # Integer and Enumeration have the same calls, and so the same references
    assert found.variables["Real"].aliases == ()
    assert found.variables["Integer"].aliases == ("Integer", "Enumeration")


def test_without_a_structure_derivatives_are_taken_as_they_come():
    found = fmi2(SPRING)
    assert found.states == ("x", "v")
    assert found.warnings == (
        "x.fmu: it has no <ModelStructure>, so its states are the variables of which another "
        "variable is the derivative",
    )


def test_a_derivative_that_names_no_state_is_known_by_its_brackets():
    found = fmi2(real("x", 1) + real("der(x)", 2), derivatives(2))
    assert found.states == ("x",)
    assert (
        "derivatives that do not name their state are assigned to the state in their brackets"
        in found.warnings[0]
    )


@pytest.mark.parametrize(
    ("structure", "why"),
    [
        (derivatives(8), "state derivative 1 is not a variable"),
        (derivatives(3, "x"), "state derivative 2 is not a variable"),
        (derivatives(3, 1), "state derivative 'x' does not say which variable"),
        (derivatives(3, 3), "lists the derivative of a state twice"),
    ],
)
def test_states_that_cannot_be_named_leave_co_simulation(structure, why):
    found = fmi2(SPRING, structure)
    assert found.interfaces == ("co_simulation",)
    (warning,) = found.warnings
    assert re.search(
        rf"^x.fmu: .*model exchange interface cannot be used.*{why}.*left out", warning
    )
    with pytest.raises(ModelError, match="must describe a usable interface, but model"):
        fmi2(SPRING, structure, interfaces='<ModelExchange modelIdentifier="m"/>')


@pytest.mark.parametrize(
    ("change", "left", "said"),
    [
        ({'EventIndicators="0"': 'EventIndicators="x"'}, 1, "number of event indicators is 'x'"),
        ({'<ModelExchange modelIdentifier="mass_spring_damper"': "<ModelExchange"}, 1,
         "model exchange interface has the modelIdentifier None, which is not a plain name, and is "
         "left out"),
        ({'completedIntegratorStepNotNeeded="true"': 'needsExecutionTool="true"'}, 2,
         "model exchange interface needs cluster-est build_fmus on this machine"),
    ],
)  # fmt: skip
def test_an_interface_with_a_fault_is_named_and_left_out_if_it_must_be(change, left, said):
    found = describe("x.fmu", spoiled_fmu(xml=change))
    assert [offer.identifier for offer in found.offers] == ["mass_spring_damper"] * left
    assert found.interfaces[-1] == "co_simulation"
    (warning,) = found.warnings
    assert said in warning
    assert left == 1 or found.offer("model_exchange").needs_execution_tool


PLAIN = f"{HEAD_2}{BOTH}<ModelVariables>{real('größe', 1)}</ModelVariables>{EMPTY}{END}"


@pytest.mark.parametrize(
    "content",
    [
        codecs.BOM_UTF8 + PLAIN.encode(),
        PLAIN.encode("utf-16"),
        b'<?xml version="1.0" encoding="ISO-8859-1"?>' + PLAIN.encode("latin-1"),
        b'<?xml version="1.0" encoding="windows-1252"?>' + PLAIN.encode("cp1252"),
        b"<!DOCTYPE fmiModelDescription>" + PLAIN.encode(),
        b"<!DOCTYPE fmiModelDescription SYSTEM 'no-such.dtd'>" + PLAIN.encode(),
    ],
    ids=["byte order mark", "utf-16", "latin-1", "cp1252", "doctype", "external doctype"],
)
def test_encodings(content):
    found = read(content)
    assert list(found.variables) == ["größe"]
    assert found.warnings == ()


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (PLAIN.encode("latin-1"), "größe"),
        (b'\n <?xml version="1.0" encoding="utf-8"?>' + PLAIN.encode(), "größe"),
        (b'<?xml version="1.0" encoding="utf-16"?>' + PLAIN.encode(), "größe"),
        (b'<?xml version="1.0" encoding="none"?>' + PLAIN.encode(), "größe"),
        (PLAIN.encode() + b"\0\0 and more", "größe"),
        (PLAIN.replace('"größe"', '"größe" description="a & b\x0b"').encode(), "größe"),
        (
            b'<?xml version="1.0" encoding="gb2312"?>'
            + PLAIN.replace("größe", "大小").encode("gb2312"),
            "大小",
        ),
    ],
    ids=["not as declared", "space before", "wrong", "unknown", "more behind", "signs", "Chinese"],
)
def test_text_that_is_no_xml_is_mended(content, name):
    found = read(content)
    assert list(found.variables) == [name]
    assert found.warnings == (
        "x.fmu: its modelDescription.xml is not well-formed XML and was corrected; check names "
        "that look wrong",
    )


def test_backslashes_in_an_archive_are_slashes():
    content = packed(PLAIN, "binaries\\linux64\\m.so", "sources\\m.c")
    found = describe("x.fmu", content)
    assert found.platforms == ("linux64",)
    assert found.has_sources


PIECES = st.sampled_from([
    *('name="x"', 'valueReference="1"', "<Real", "</ScalarVariable>", 'start="1"', 'index="3"'),
    *('derivative="1"', "ModelStructure", "Derivatives", 'guid="{g}"', 'fmiVersion="2.0"', "/>"),
    *('modelIdentifier="m"', "CoSimulation", "ModelVariables", "<", ">", '"', "der(x)"),
])  # fmt: skip
OTHERS = st.one_of(
    st.text(max_size=6),
    st.sampled_from(['"', "", "odd", "1e999", "-1", "99", "<x>", "&", "&#0;", "9" * 50, "\x0b"]),
)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.tuples(PIECES, OTHERS, st.integers(1, 3)), min_size=1, max_size=3))
def test_any_damage_loads_or_is_answered_with_advice(changes):
    text = f"{HEAD_2}{BOTH}<ModelVariables>{SPRING}</ModelVariables>{derivatives(3, 4)}{END}"
    for old, new, times in changes:
        text = text.replace(old, new, times)
    try:
        found = read(text.encode("utf-8", "replace"))
    except ModelError as error:
        message = str(error)
        assert message.startswith("x.fmu: ")
        assert "; export" in message or "; remove" in message
    else:
        assert found.offers
        assert set(found.states) <= set(found.variables)
        assert all(s.startswith("x.fmu: ") and "\n" not in s for s in found.warnings)
