import re

import pytest
from support.described import END, HEAD_3, fmi3, read

from workers.errors import ModelError

TIME = '<Float64 name="time" valueReference="0" causality="independent"/>'
SPRING = (
    TIME + '<Float64 name="x" valueReference="1" start="1" initial="exact"><Alias name="place"/>'
    '</Float64><Float64 name="v" valueReference="2"/>'
    '<Float64 name="rate of x" valueReference="3" derivative="1"/>'
    '<Float64 name="rate of v" valueReference="4" derivative="2"/>'
    '<Float64 name="y" valueReference="5" causality="output"/>'
    '<Float64 name="u" valueReference="6" causality="input" start="0"/>'
)
STRUCTURE = (
    '<ModelStructure><Output valueReference="5" dependencies="1"/>'
    '<ContinuousStateDerivative valueReference="4" dependencies="1 2 6"/>'
    '<ContinuousStateDerivative valueReference="3" dependencies=""/>'
    '<EventIndicator valueReference="1"/></ModelStructure>'
)
SIZED = (
    '<UInt64 name="n" valueReference="7" causality="structuralParameter" variability="tunable"'
    ' start="2"/>'
)


NOTHING = "<ModelStructure/>"
EMPTY_ARRAY = 'name="a" valueReference="8"'


def array(attributes: str, inside: str) -> str:
    return f"<Float64 {attributes}>{inside}</Float64>"


def test_states_are_in_the_order_of_the_structure():
    found = fmi3(SPRING, STRUCTURE)
    assert found.version == "3.0"
    assert found.guid == "{g}"
    assert found.states == ("v", "x")
    assert found.outputs == ("y",)
    assert found.event_indicators == 1
    assert found.variables["rate of x"].derivative_of == "x"
    assert found.warnings == ()


def test_dependencies_are_told_where_declared():
    found = fmi3(SPRING, STRUCTURE.replace(' dependencies="1"/', "/")).dependencies
    assert [(each.name, each.role, each.on) for each in found] == [
        ("y", "output", None),
        ("rate of v", "derivative", ("x", "v", "u")),
        ("rate of x", "derivative", ()),
    ]


def test_an_alias_is_a_variable_of_its_own():
    found = fmi3(SPRING, STRUCTURE)
    place = found.variables["place"]
    assert (place.reference, place.alias_of, place.start) == (1, "x", 1.0)
    assert set(place.aliases) == {"x", "place"} == set(found.variables["x"].aliases)
    assert found.variables["v"].aliases == ()


def test_another_name_of_an_input_is_no_input_of_its_own():
    found = fmi3(
        '<Float64 name="u" valueReference="6" causality="input" start="0"><Alias name="force"/>'
        "</Float64>",
        NOTHING,
    )
    assert [v.name for v in found.inputs()] == ["u"]


@pytest.mark.parametrize(
    ("type_name", "kind"),
    [
        *(("Float64", "real"), ("Float32", "real"), ("Int8", "integer"), ("UInt8", "integer")),
        *(("Int16", "integer"), ("UInt16", "integer"), ("Int32", "integer"), ("UInt32", "integer")),
        *(("Int64", "integer"), ("UInt64", "integer"), ("Enumeration", "integer")),
        *(("Boolean", "boolean"), ("String", "string"), ("Binary", "binary"), ("Clock", "clock")),
    ],
)
def test_every_type(type_name, kind):
    found = fmi3(f'<{type_name} name="a" valueReference="1"/>', NOTHING)
    variable = found.variables["a"]
    assert (variable.type, variable.kind) == (type_name, kind)
    assert variable.variability == ("continuous" if kind == "real" else "discrete")


def test_start_values():
    found = fmi3(
        '<Boolean name="b" valueReference="1" start="true false"><Dimension start="2"/></Boolean>'
        '<Int8 name="i" valueReference="2" start="-3"/>'
        '<String name="s" valueReference="3"><Start value="7"/></String>',
        NOTHING,
    ).variables
    assert [found[n].start for n in ("b[1]", "b[2]", "i", "s")] == [1.0, 0.0, -3.0, None]


def test_an_array_is_its_elements_in_row_major_order():
    found = fmi3(
        '<Float64 name="A" valueReference="9" start="1 2 3 4 5 6" unit="m" max="10" nominal="2"'
        ' causality="parameter" variability="tunable"><Dimension start="2"/><Dimension start="3"/>'
        "</Float64>",
        NOTHING,
    ).variables
    assert list(found) == ["A[1,1]", "A[1,2]", "A[1,3]", "A[2,1]", "A[2,2]", "A[2,3]"]
    assert [v.start for v in found.values()] == [1, 2, 3, 4, 5, 6]
    assert [v.element for v in found.values()] == [0, 1, 2, 3, 4, 5]
    third = found["A[2,1]"]
    assert (third.reference, third.shape, third.size) == (9, (2, 3), 6)
    assert (third.unit, third.high, third.nominal, third.tunable) == ("m", 10.0, 2.0, True)


def test_elements_of_array_states_are_states():
    found = fmi3(
        '<Float64 name="x" valueReference="1" start="1 2"><Dimension start="2"/>'
        '<Alias name="z"/></Float64>'
        '<Float64 name="dx" valueReference="2" derivative="1"><Dimension start="2"/></Float64>'
        '<Float64 name="e" valueReference="3"><Dimension start="3"/></Float64>',
        '<ModelStructure><ContinuousStateDerivative valueReference="2"/>'
        '<EventIndicator valueReference="3"/></ModelStructure>',
    )
    assert found.states == ("x[1]", "x[2]")
    assert found.event_indicators == 3
    assert found.variables["dx[2]"].derivative_of == "x[2]"
    assert found.variables["z[2]"].alias_of == "x[2]"
    assert set(found.variables["z[2]"].aliases) == {"x[2]", "z[2]"}


@pytest.mark.parametrize(
    ("start", "structural", "starts"),
    [
        ("5 6", {}, [5.0, 6.0]),
        ("5 6", {"n": 3}, [None] * 3),
        ("5 6", {"n": 0}, []),
        ("5", {"n": 3}, [5.0, 5.0, 5.0]),  # one start value is that of every element
    ],
)
def test_structural_parameters_decide_sizes(start, structural, starts):
    sized = array(f'{EMPTY_ARRAY} start="{start}"', '<Dimension valueReference="7"/>')
    found = fmi3(SIZED + sized, NOTHING, structural=structural)
    elements = [v for v in found.variables.values() if v.shape]
    assert [v.name for v in elements] == [f"a[{k + 1}]" for k in range(len(starts))]
    assert [v.start for v in elements] == starts
    assert found.variables["n"].settable
    assert (found.warnings == ()) is (not structural or start == "5")


@pytest.mark.parametrize(
    ("structural", "sentence"),
    [({"k": 1}, "has no structural parameter 'k'"), ({"n": -1}, "must be a size")],
)
def test_structural_parameters_that_cannot_be(structural, sentence):
    with pytest.raises(ModelError, match=sentence):
        fmi3(SIZED, NOTHING, structural=structural)


@pytest.mark.parametrize("dimension", ['valueReference="99"', "", 'start="-1"', 'start="x"'])
def test_an_array_of_unknown_size_is_left_out(dimension):
    found = fmi3(array(EMPTY_ARRAY, f"<Dimension {dimension}/>"), NOTHING)
    assert found.variables == {}
    assert found.warnings == ("x.fmu: arrays of unknown size are left out: 'a'",)


def test_an_array_of_any_size_does_not_fill_the_memory():
    found = fmi3(
        array(EMPTY_ARRAY, '<Dimension start="99999"/><Dimension start="99999"/>')
        + '<Float64 name="b" valueReference="9"><Dimension start="10"/></Float64>',
        NOTHING,
    )
    assert len(found.variables) == 10
    assert re.search(r"arrays are left out after \d+ elements in all: 'a'", found.warnings[0])


def test_the_name_of_an_array_is_answered_with_an_element():
    found = fmi3('<Float64 name="a" valueReference="8"><Dimension start="2"/></Float64>')
    with pytest.raises(ModelError, match=r"an array of that name; name one of its elements, such"):
        found.variable("a", "outputs")


def test_what_its_interfaces_can_do():
    found = fmi3(
        SPRING,
        STRUCTURE
        + '<DefaultExperiment startTime="1" stopTime="2" stepSize="0.1" tolerance="1e-4"/>',
        interfaces='<ModelExchange modelIdentifier="m" needsCompletedIntegratorStep="true"'
        ' canGetAndSetFMUState="true"/><CoSimulation modelIdentifier="c" hasEventMode="1"'
        ' canHandleVariableCommunicationStepSize="true" fixedInternalStepSize="0.01"'
        ' providesDirectionalDerivatives="true" canInterpolateInputs="true"/>',
    )
    exchange, simulation = (found.offer(i) for i in found.interfaces)
    assert (exchange.identifier, simulation.identifier) == ("m", "c")
    assert (exchange.can_get_set_state, simulation.can_get_set_state) == (True, False)
    assert not exchange.provides_directional_derivatives
    assert simulation.provides_directional_derivatives
    assert found.completes_steps
    assert found.variable_steps
    assert found.has_event_mode
    assert not found.interpolates_inputs  # gone in FMI 3
    assert (found.default_start, found.default_stop) == (1.0, 2.0)
    assert (found.default_step, found.default_tolerance) == (0.1, 1e-4)
    assert found.fixed_internal_step == 0.01


DERIVATIVE = '<ContinuousStateDerivative valueReference="{}"/>'.format


@pytest.mark.parametrize(
    ("structure", "why"),
    [
        (DERIVATIVE(77), "state derivative 1 is not a variable"),
        (DERIVATIVE(5), "state derivative 'y' does not say which variable"),
        (DERIVATIVE(3) * 2, "lists the derivative of a state twice"),
        ('<EventIndicator valueReference="x"/>', "one of its event indicators is not a variable"),
    ],
)
def test_model_exchange_needs_a_structure_that_holds(structure, why):
    structure = f"<ModelStructure>{structure}</ModelStructure>"
    found = fmi3(SPRING, structure)
    assert found.interfaces == ("co_simulation",)
    (warning,) = found.warnings
    assert re.search(
        rf"^x.fmu: .*model exchange interface cannot be used.*{why}.*left out", warning
    )
    with pytest.raises(ModelError, match=f"cannot be used.*{why}.*; export it again"):
        fmi3(SPRING, structure, interfaces='<ModelExchange modelIdentifier="m"/>')


@pytest.mark.parametrize(
    ("version", "warning"),
    [("3.0", ""), ("3.0.2", ""), ("3.1", "its FMI version is 3.1, which is read as 3.0")],
)
def test_later_versions_are_read(version, warning):
    found = read(HEAD_3.replace("3.0", version) + '<CoSimulation modelIdentifier="m"/>' + END)
    assert found.version == "3.0"
    assert any(warning in sentence for sentence in found.warnings)


@pytest.mark.parametrize(
    ("version", "interface", "said"),
    [
        ("3.0-beta.2", "CoSimulation", r"version 2.0 or 3.0, but is of 3.0-beta.2; export it in"),
        ("3.0", "ScheduledExecution", "offers only scheduled execution; export it with one"),
    ],
)
def test_what_no_program_of_today_makes_is_refused(version, interface, said):
    with pytest.raises(ModelError, match=said):
        read(HEAD_3.replace("3.0", version) + f'<{interface} modelIdentifier="m"/>' + END)
