"""A fault of a record, with its sentence and the config key that corrects it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from cluster_est.problem.display import readable_time
from cluster_est.toml import dotted

FaultKind = Literal[
    "gain", "offset", "sign", "unit", "delay", "clock", "swapped", "initial state", "foreign source"
]
Sort = Literal["inputs", "outputs", "times"]

UNKNOWN_COLUMN = "COLUMN"
"""Stands for a column whose name is not known, such as that of an array in Python."""

UNIT_FACTORS: tuple[tuple[float, float, str], ...] = (
    (180.0 / math.pi, 0.0, "degrees for radians"),
    (30.0 / math.pi, 0.0, "1/min for rad/s"),
    (1000.0, 0.0, "milli-units such as mm for units such as m"),
    (1e6, 0.0, "micro-units such as um for units such as m"),
    (100.0, 0.0, "percent or cm for fractions or m"),
    (60.0, 0.0, "per minute for per second"),
    (3600.0, 0.0, "per hour for per second"),
    (3.6, 0.0, "km/h for m/s"),
    (1e5, 0.0, "Pa for bar"),
    (9.80665, 0.0, "newtons for kilograms-force"),
    (1.8, 0.0, "degrees Fahrenheit for kelvins (as differences)"),
    (1.0, 273.15, "K for degC"),
    (1.8, 32.0, "degF for degC"),
    (1.8, -459.67, "degF for K"),
)
"""Confusions of units: the column contains factor times the right number, plus an offset. Each may
also be the other way round."""
SAME_FACTOR = 0.03
"""Relative distance from a unit's factor up to which a gain counts as this confusion of units."""
SAME_OFFSET = 0.01
"""Relative distance from a unit's offset up to which an offset counts as this confusion."""


@dataclass(frozen=True)
class RecordFault:
    """A fault of one record, or of all records.

    Attributes
    ----------
    kind
        The kind of the fault.
    experiment
        Id of the experiment; "" for all records.
    sort, variables
        Whether inputs or outputs are wrong, and their names.
    size
        A gain (column over right value), an offset (column minus right value), a shift in seconds
        or of an initial state, or a frequency in hertz. NaN if the fault has no size.
    before, after
        The largest root mean square residual of the record's outputs over the noise, with the
        fault, and after its correction.
    unit
        Unit of the quantity, or the confusion of units.
    others
        Other faults that these data cannot distinguish from this one.
    frequencies
        Lowest and highest frequency of a foreign source.
    factor, offset
        Factor and offset that correct the column; for an initial state, the offset is its value.
    column
        Column of the table, if it is known.
    held_out
        As `after`, in held-out experiments, for a fault of all records; 0 if there are none.
    """

    kind: FaultKind
    experiment: str
    sort: Sort
    variables: tuple[str, ...]
    size: float
    before: float
    after: float
    unit: str = ""
    others: tuple[str, ...] = ()
    frequencies: tuple[float, float] = (math.nan, math.nan)
    factor: float = 1.0
    offset: float = 0.0
    column: str = UNKNOWN_COLUMN
    held_out: float = math.nan

    @property
    def sentence(self) -> str:
        """The fault, its evidence, and its correction, as a sentence."""
        if self.kind == "foreign source":
            return f"check the records first: {self.said}; {self.remedy}"
        alike = (
            f" (or {' or '.join(self.others)}, which would look the same in these data)"
            if self.others
            else ""
        )
        if not self.experiment:
            tests = f" ({self.held_out:.2g} in held-out experiments)" if self.held_out else ""
            return (
                f"check the records first: {self.said}, in all experiments{alike}; with the "
                f"correction and fitted parameters, the error falls from {self.before:.2g} to "
                f"{self.after:.2g} times the noise{tests}; {self.remedy}"
            )
        own = f"experiment {self.experiment}"
        apart = (
            f"{own} is the faulty one, because without it the other experiments fit to within the "
            f"noise; its error is {self.before:.2g} times the noise, and {self.after:.2g} times "
            "after the correction"
        )
        return f"check the record of {own} first: {self.said}{alike}; {apart}; {self.remedy}"

    @property
    def said(self) -> str:
        """The fault without evidence and correction."""
        name, what = " and ".join(self.variables), self.sort.removesuffix("s")
        if self.kind == "gain":
            how = "large" if abs(self.size) > 1.0 else "small"
            factor = abs(self.size) if abs(self.size) > 1.0 else 1.0 / abs(self.size)
            return f"{what} {name} seems to be {factor:.4g} times too {how}"
        if self.kind == "sign":
            return f"{what} {name} seems to have the wrong sign"
        if self.kind == "offset":
            unit = f" {self.unit}" if self.unit not in ("", "1") else ""
            where = "high" if self.size > 0.0 else "low"
            return f"{what} {name} is {abs(self.size):.4g}{unit} too {where}"
        if self.kind == "unit":
            of = "the column of" if self.sort == "times" else what
            return (
                f"{of} {name} seems to be in the wrong unit: "
                f"{self.unit.replace(' for ', ' instead of ')}"
            )
        late = "late" if self.size > 0.0 else "early"
        if self.kind == "delay":
            return f"{what} {name} is {readable_time(abs(self.size))} {late}"
        if self.kind == "clock":
            return (
                f"all outputs are {readable_time(abs(self.size))} {late} relative to the inputs, "
                "which suggests a clock offset"
            )
        if self.kind == "swapped":
            return f"{self.sort} {name} seem to be swapped"
        if self.kind == "initial state":
            return f"its initial state {name} differs from the declared one"
        low, high = self.frequencies
        return (
            f"an unmeasured periodic disturbance acts on {name}; its frequencies, {low:.4g} to "
            f"{high:.4g} Hz, differ between records and occur in no input"
        )

    @property
    def remedy(self) -> str:
        """The config keys that correct the fault."""
        aside = 'or leave the record out of the fit with role = "test"' if self.experiment else ""
        return ", ".join(filter(None, (self._key, aside)))

    @property
    def _key(self) -> str:
        where = f" in experiment {self.experiment}" if self.experiment else ""
        if self.kind in ("gain", "sign", "offset", "unit"):
            numbers = {"factor": self.factor, "offset": self.offset}
            plain = {"factor": 1.0, "offset": 0.0}
            given = [f"{k} = {v:.6g}" for k, v in numbers.items() if v != plain[k]]
            key = dotted("columns", self.column)
            instead = ""
            if self.sort == "times" and self.column == UNKNOWN_COLUMN:
                instead = (
                    ", with the name of the time column, or a sample_time multiplied by "
                    f"{self.factor:.6g},"
                )
            return f"{key} = {{ {', '.join(given)} }}{instead}{where} corrects it"
        if self.kind in ("delay", "clock"):
            each = " for each output" if self.kind == "clock" else ""
            key = dotted("columns", UNKNOWN_COLUMN if each else self.column)
            return f"{key} = {{ late = {self.size:.6g} }}{where}{each} corrects it"
        if self.kind == "swapped":
            pairs = ", ".join(dotted(self.sort, name) for name in self.variables)
            return f"exchange the columns of {pairs}{where}"
        if self.kind == "initial state":
            state, start = self.variables[0], f"{self.offset:.4g}"
            free = f'{dotted("parameters", state)} = {{ start = {start}, per = "experiment" }}'
            return (
                f"{dotted('values', state)} = {start}{where} corrects it; or estimate it with "
                f"{free}"
            )
        return (
            "measure the disturbance and name its column in signals, or find its source and "
            "remove it"
        )


def as_unit(factor: float, offset: float, spread: float) -> str:
    """Return the probable confusion of units of a column; "" for none.

    Parameters
    ----------
    factor, offset
        The column contains factor times the right value, plus the offset.
    spread
        Standard deviation of the column; an offset must be large compared with it.
    """
    for own, shift, words in UNIT_FACTORS:
        one, _, other = words.partition(" for ")
        turned = f"{other} for {one}" if other else f"the inverse of {words}"
        for scale, move, said in ((own, shift, words), (1.0 / own, -shift / own, turned)):
            near = abs(factor / scale - 1.0) <= SAME_FACTOR
            moved = abs(offset - move) <= max(SAME_OFFSET * abs(move), 0.1 * spread)
            if near and moved and (move == 0.0 or abs(move) > spread):
                return said
    return ""
