"""Units as an FMU defines them, by powers of base units."""

from support.described import fmi2
from support.problems.springs import FMU

from workers.fmu.description import describe
from workers.fmu.parsing.units import BASE_UNITS, UnitDefinition

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
    assert warning.endswith("powers that are no whole numbers count as names alone: 'V^0.5'")
    assert fmi2("", "<ModelStructure/>").units == {}


def test_a_description_has_the_units_of_its_variables():
    description = describe(FMU.name, FMU.read_bytes())
    assert description.units[description.variables["v"].unit].powers == powers(m=1, s=-1)
