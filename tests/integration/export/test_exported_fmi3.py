"""Repaired FMUs whose original is of FMI 3.0: types, arrays, and what FMI 2.0 has no words for."""

import zipfile
from ctypes import byref, c_double, c_int
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from support.described import packed
from support.exported import Exported, co_simulated, repair_of, unpacked, written

from cluster_est.errors import ModelError
from workers.messages import Effect, Experiment, Model, Output, Solver

TUPLE = "x86_64-linux"
DISCARD, LAST_SUCCESSFUL_TIME, TERMINATED = 2, 2, 3
TIMES = np.linspace(0.0, 1.0, 11)
RATES = (1.0, 2.0, 3.0, 4.0)
KNOWN = (
    ("n", 4), ("integer", 7), ("boolean", False), ("mode", 3), ("text", "longer"), ("int8", -3),
    ("float32", 0.25), ("weights[2]", 5.0),
    *((f"rates[{k}]", RATES[k - 1]) for k in (1, 3, 4)),
    *((f"z[{k}]", 1.0) for k in (1, 2, 3, 4)),
)  # fmt: skip
SLOWED = Effect("slowed", "der(z[3])", "linear", ("z[3]",))


def repair(own_fmu, *known):
    """Variables of every type, with four states z that decay, one the slower by an effect."""
    archive = own_fmu("types", 3)
    outputs = tuple(Output(f"y_z[{k}]", TIMES, np.zeros(11)) for k in (1, 2, 3, 4))
    measured = Experiment("e", 0.0, 1.0, (), outputs, (*KNOWN, *known))
    solver = Solver("dormand_prince", rtol=1e-10)
    content = archive.read_bytes()
    model = Model(archive.name, content, "model_exchange", solver, ("rates[2]",), (("n", 4),))
    return repair_of(model, measured, (RATES[1],), (SLOWED,), (0.5,))


@pytest.fixture(scope="module")
def types(own_fmu, tmp_path_factory):
    """The exported FMU as a file, and the notes on it."""
    path = tmp_path_factory.mktemp("types") / "types.fmu"
    return path, written(repair(own_fmu), path)


@pytest.fixture(scope="module")
def folder(types):
    return Path(extract(str(types[0]), str(types[0].parent / "unpacked")))


@pytest.fixture
def exported(folder):
    said = []
    made = Exported(folder, said=said)
    made.said = said
    yield made
    made.fmu.freeInstance()


def reference(exported, name):
    return [exported.references[name]]


@pytest.mark.slow
def test_the_description_is_one_of_fmi_2(types):
    path, notes = types
    assert validate_fmu(str(path)) == []
    described = read_model_description(str(path))
    variables = {v.name: v for v in described.modelVariables}
    assert described.fmiVersion == "2.0"
    assert "blob" not in variables
    assert any("does not show blob, y_blob, because FMI 2.0 cannot" in note for note in notes)
    kinds = {"float32": "Real", "uint64": "Integer", "mode": "Enumeration", "boolean": "Boolean"}
    assert {name: variables[name].type for name in kinds} == kinds
    assert (variables["n"].variability, variables["n"].start) == ("constant", "4")
    assert [variables[f"rates[{k}]"].start for k in (1, 2, 3, 4)] == ["1.0", "2.0", "3.0", "4.0"]
    starts = {name: variables[name].start for name in ("integer", "boolean", "mode", "text")}
    assert starts == {"integer": "7", "boolean": "false", "mode": "3", "text": "longer"}
    rates = [unknown.variable.name for unknown in described.derivatives]
    assert rates == ["der(x)", "der(z)[1]", "der(z)[2]", "der(z)[3]", "der(z)[4]"]


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_elements_of_arrays_move_as_they_should(exported, k):
    """A structural parameter says how many there are; the closed form says how they go."""
    exported.begin({})
    found = co_simulated(exported, TIMES, {}, f"y_z[{k}]")
    rate = RATES[k - 1] - (0.5 if k == 3 else 0.0)
    np.testing.assert_allclose(found, np.exp(-rate * TIMES), rtol=0.0, atol=1e-8)


def read(exported, name):
    """A value that is no real number, or three of a vector."""
    if name == "y_vector":
        return [exported.get(f"y_vector[{k}]") for k in (1, 2, 3)]
    kinds = {"y_boolean": exported.fmu.getBoolean, "y_text": exported.fmu.getString}
    return kinds.get(name, exported.fmu.getInteger)(reference(exported, name))[0]


def test_values_of_every_type(exported):
    """Those of the run first; then others, again after a reset."""
    fmu = exported.fmu
    of_the_run = {"y_integer": 7, "y_int8": -3, "y_boolean": 0, "y_mode": 3, "y_text": b"longer"}
    for _ in range(2):
        exported.begin({"u_vector[2]": 10.0, "u_float32": 0.5})
        assert {name: read(exported, name) for name in of_the_run} == of_the_run
        assert read(exported, "y_vector") == [1.0, 15.0, 3.0]
        assert exported.get("y_float32") == 0.75
        fmu.reset()
    fmu.setInteger(reference(exported, "uint8"), [200])
    fmu.setInteger(reference(exported, "integer"), [-8])
    fmu.setBoolean(reference(exported, "boolean"), [True])
    fmu.setString(reference(exported, "text"), ["x"])
    exported.begin({"weights[3]": 0.0})
    others = {"y_uint8": 200, "y_integer": -8, "y_boolean": 1, "y_text": b"x"}
    assert {name: read(exported, name) for name in others} == others
    assert read(exported, "y_vector") == [1.0, 5.0, 0.0]


def test_integers_that_are_too_large_are_an_error(exported):
    """For the original, and for FMI 2.0."""
    with pytest.raises(FMICallException):
        exported.fmu.setInteger(reference(exported, "uint8"), [256])
    assert any("out of the range of its type in FMI 3.0" in text for text in exported.said)
    exported.fmu.setInteger(reference(exported, "int64"), [2_000_000_000])
    exported.begin({})
    exported.fmu.setInteger(reference(exported, "u_int64"), [2_000_000_000])
    with pytest.raises(FMICallException):
        exported.fmu.getInteger(reference(exported, "y_int64"))
    assert any("an integer is too large for FMI 2.0" in text for text in exported.said)


def test_get_and_set_state(exported):
    """Half way, and before there is anything to be read from an array."""
    fmu = exported.fmu
    exported.set("weights[1]", 40.0)
    early = fmu.getFMUState()
    exported.set("weights[1]", 50.0)
    fmu.setFMUState(early)
    exported.set("weights[3]", 60.0)
    exported.begin({})
    assert read(exported, "y_vector") == [40.0, 5.0, 60.0]
    co_simulated(exported, TIMES[:6], {}, "y")
    kept = fmu.serializeFMUstate(fmu.getFMUState())
    rest = co_simulated(exported, TIMES, {}, "y", first=5)
    fmu.setFMUState(fmu.deSerializeFMUstate(kept))
    again = co_simulated(exported, TIMES, {}, "y", first=5)
    assert again.tobytes() == rest.tobytes()
    assert rest[-1] > rest[0]


def test_what_the_run_needs_and_fmi_2_has_not_is_refused(own_fmu, tmp_path):
    with pytest.raises(
        ModelError, match=r"'int64' is .* of FMI 3.0, which has no equivalent there"
    ):
        written(repair(own_fmu, ("int64", 2**40)), tmp_path / "types.fmu")


@pytest.mark.slow
def test_an_original_that_ends_the_simulation_says_so(own_fmu, tmp_path):
    """The stair ends at 10 s; FMI 2.0 says it by a discarded step."""
    archive = own_fmu("stair", 3)
    output = Output("y", np.array([0.0, 8.0]), np.zeros(2))
    model = Model(archive.name, archive.read_bytes(), "co_simulation", Solver("fmu"), ())
    repair = repair_of(model, Experiment("e", 0.0, 8.0, (), (output,)), (), (), ())
    exported = Exported(unpacked(repair, tmp_path))
    exported.begin({})
    ended = c_int(0)
    exported.fmu.fmi2DoStep(exported.fmu.component, 0.0, 8.0, 1)
    exported.fmu.fmi2GetBooleanStatus(exported.fmu.component, TERMINATED, byref(ended))
    assert ended.value == 0
    with pytest.raises(FMICallException) as raised:
        exported.fmu.fmi2DoStep(exported.fmu.component, 8.0, 8.0, 1)
    exported.fmu.fmi2GetBooleanStatus(exported.fmu.component, TERMINATED, byref(ended))
    time = c_double(0.0)
    exported.fmu.fmi2GetRealStatus(exported.fmu.component, LAST_SUCCESSFUL_TIME, byref(time))
    assert (raised.value.status, ended.value, time.value) == (DISCARD, 1, pytest.approx(9.0))
    exported.fmu.freeInstance()


RICH = """<fmiModelDescription fmiVersion="3.0" modelName="rich" instantiationToken="t">
<ModelExchange modelIdentifier="rich" providesDirectionalDerivatives="true"/>
<UnitDefinitions><Unit name="K"><BaseUnit K="1"/><DisplayUnit name="degC" offset="-273.15"/>
<DisplayUnit name="1/K" inverse="true"/></Unit></UnitDefinitions>
<TypeDefinitions><Float32Type name="Hot" unit="K" displayUnit="degC" min="0"/>
<Int64Type name="Count" min="0" max="9000000000"/><BinaryType name="Bytes"/>
<EnumerationType name="Far"><Item name="one" value="9000000000"/></EnumerationType>
</TypeDefinitions>
<LogCategories><Category name="events"/></LogCategories>
<ModelVariables>
<Float64 name="t" valueReference="0" causality="independent"/>
<Float32 name="T" valueReference="1" causality="output" declaredType="Hot" unit="K"
 displayUnit="1/K"><Alias name="same"/></Float32>
<Int64 name="n" valueReference="2" causality="parameter" variability="fixed" start="3"
 declaredType="Count"/>
<Enumeration name="far" valueReference="3" declaredType="Far" causality="input" start="7"/>
<UInt64 name="vast" valueReference="4" causality="parameter" variability="fixed"
 start="9000000000"/>
<String name="texts" valueReference="5" causality="parameter" variability="fixed">
<Dimension start="2"/><Start value="a"/><Start value="b"/></String>
<Clock name="clock" valueReference="6" causality="input" intervalVariability="triggered"/>
<Float64 name="v" valueReference="7" initial="exact" start="1 2"><Dimension start="2"/></Float64>
</ModelVariables>
<ModelStructure><Output valueReference="1" dependencies="7 6"
 dependenciesKind="dependent dependent"/>
<InitialUnknown valueReference="1"/></ModelStructure>
</fmiModelDescription>"""


def test_units_and_types_are_kept_and_the_rest_is_left_out(tmp_path):
    """It is described alone: there is no code that could be loaded."""
    archive = packed(RICH, f"binaries/{TUPLE}/rich.so")
    output = Output("T", TIMES, np.zeros(11))
    model = Model("rich.fmu", archive, "model_exchange", Solver("dormand_prince"), ())
    path = tmp_path / "rich_repaired.fmu"
    notes = written(repair_of(model, Experiment("e", 0.0, 1.0, (), (output,)), (), (), ()), path)
    assert any("show vast, texts[1], texts[2], clock, because FMI 2" in note for note in notes)
    assert validate_fmu(str(path)) == []
    variables = {v.name: v for v in read_model_description(str(path)).modelVariables}
    hot, far = variables["T"], variables["far"]
    assert (hot.type, hot.declaredType.name) == ("Real", "Hot")
    assert (hot.unit, hot.displayUnit) == ("K", None)
    assert variables["same"].valueReference == hot.valueReference
    assert (variables["n"].declaredType.name, variables["n"].declaredType.max) == ("Count", None)
    assert (far.type, far.start) == ("Integer", "7")
    assert [float(variables[f"v[{k}]"].start) for k in (1, 2)] == [1.0, 2.0]
    with zipfile.ZipFile(path) as opened:
        root = ElementTree.fromstring(opened.read("modelDescription.xml"))
    assert root.find("ModelExchange").get("providesDirectionalDerivative") is None
    (unknown,) = root.findall("ModelStructure/Outputs/Unknown")
    assert unknown.get("dependencies") == "6 7"
