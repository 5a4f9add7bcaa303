"""Files as loggers, spreadsheets and databases write them, each with what is in it.

Every file has the same test of a mass on a spring: the force F in newtons and the position y in
metres. What is expected of a reader comes from the numbers that were written, in the seconds and
metres that the file's own words mean.
"""

import datetime as dt
import gzip
import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import feather
from scipy.io import savemat
from support.problems.springs import FMU

ROWS = 60
T = np.round(0.02 * np.arange(ROWS), 2)
F = np.round(3.0 * np.sin(7.0 * T), 3)
Y = np.round(0.05 + 0.04 * np.cos(6.0 * T), 4)
START = dt.datetime(2026, 1, 1, 10, 0, 0)
DAYS = np.arange(0.0, 86400.0 * ROWS, 86400.0)


@dataclass
class Case:
    """A file, and what it means.

    Attributes
    ----------
    name
        Of the case.
    make
        Writes it into a folder and returns its path.
    t, f, y
        What is in it.
    read, map
        Arguments of `init`.
    refused
        What is said, where it cannot be read as it is.
    said
        What `init`, its config or `check` says, where a file cannot be read as it is.
    edit
        (what, by what): an edit that the config of `init` needs, besides unknowns.
    notes
        What `init` says.
    """

    name: str
    make: Callable[[Path], Path]
    t: np.ndarray = field(default_factory=lambda: T)
    f: np.ndarray = field(default_factory=lambda: F)
    y: np.ndarray = field(default_factory=lambda: Y)
    read: tuple[str, ...] = ()
    map: tuple[str, ...] = ()
    refused: str = ""
    edit: tuple[tuple[str, str], ...] = ()
    notes: str = ""
    said: str = ""
    ty: np.ndarray | None = None


CASES: list[Case] = []


def case(name, make, **more):
    CASES.append(Case(name, make, **more))


def written(content, ending=".csv", encoding="utf-8"):
    """A file of a text or of bytes."""

    def make(folder):
        path = folder / f"log{ending}"
        path.write_bytes(content.encode(encoding) if isinstance(content, str) else content)
        return path

    return make


def plain(number):
    return f"{number:.10g}"


def comma(number):
    return plain(number).replace(".", ",")


def table(times=None, head=("time", "F", "y"), sep=",", number=plain, end="\n", y=Y, f=F, after=""):
    """Rows of a text; `times` are texts already."""
    times = [number(t) for t in T] if times is None else times
    rows = zip(times, map(number, f), map(number, y), strict=True)
    return end.join([sep.join(head), *(sep.join(row) + after for row in rows)]) + end


def _rows():
    return [(float(t), float(f), float(y)) for t, f, y in zip(T, F, Y, strict=True)]


def _grouped(number, thousands, decimal):
    text = f"{number:,.4f}".rstrip("0").rstrip(".")
    return text.replace(",", "\0").replace(".", decimal).replace("\0", thousands)


GERMAN = ("Zeit [s]", "F [N]", "y [mm]")
MM = np.round(1e3 * Y, 1)
DE = {"sep": ";", "number": comma, "head": GERMAN, "y": MM}


def stamps(form, step=0.02, start=START):
    """Timestamps; {ms} and {us} are the decimals of seconds."""
    found = []
    for i in range(ROWS):
        when = start + dt.timedelta(microseconds=round(i * step * 1e6))
        text = when.strftime(form)
        found.append(
            text.replace("{ms}", f"{when.microsecond // 1000:03d}").replace(
                "{us}", f"{when.microsecond:06d}"
            )
        )
    return found


# text: separators, decimals, encodings
case("csv", written(table()))
case("csv of Windows", written(table(end="\r\n")))
case("csv with a mark", written("\ufeff" + table()))
case("German csv", written(table(**DE)))
case("German text with tabs", written(table(**(DE | {"sep": "\t"})), ".txt"))
case("bars between cells", written(table(sep="|"), ".txt"))
case("blanks between cells", written(table(sep="   "), ".txt"), notes="separated by blanks")
case(
    "aligned with blanks",
    written(
        "\n".join(" ".join(f"{c:>12}" for c in r.split(",")) for r in table().split("\n")).replace(
            "             \n", ""
        ),
        ".dat",
    ),
)
case(
    "quoted",
    written(
        "\n".join(",".join(f'"{c}"' for c in row.split(",")) for row in table().strip().split("\n"))
        + "\n"
    ),
)
case("packed by gzip", lambda folder: _packed(folder))
case(
    "cp1252 with a degree sign",
    written(
        table([f"23,4;{comma(t)}" for t in T], **(DE | {"head": ("T [°C]", *GERMAN)})),
        encoding="cp1252",
    ),
    notes="read as cp1252, which is a guess; if it is wrong",
)
case("UTF-16 of Excel", written(table(**(DE | {"sep": "\t"})), ".txt", "utf-16"))
case("UTF-16, large end first", written("\ufeff" + table(**DE), encoding="utf-16-be"))
case(
    "UTF-16 without a mark",
    written(table(**DE), encoding="utf-16-le"),
    notes="no byte order mark and is read as UTF-16-LE, which is a guess",
)
case(
    "UTF-16 said to be so", written(table(**DE), encoding="utf-16-le"), read=("encoding=utf-16-le",)
)
case(
    "a text that is no UTF-8 far from the beginning",
    written(
        _far := (
            table(head=("time", "F", "y", "note"), after="," + "n" * 6000)[:-10] + "Geräte\n"
        ).encode("cp1252")
    ),
    notes="read as cp1252, which is a guess; if it is wrong",
)
case(
    "an encoding that cannot be guessed",
    written(table(head=("time", "F", "y \u4e81")).encode("gb18030") + b"0.5\x81\x8d,1,1\n"),
    refused=r"neither UTF-8 nor cp1252.*add encoding = ",
)

# text: what stands above and between
PREAMBLE = "Logger XY 3000\nSerial number;12345\nDate;2026-01-01\n"
case("lines above", written(PREAMBLE + table(**DE)), notes="header is in row 4.*skip_rows = 3")
case("lines above, said", written(PREAMBLE + table(**DE)), read=("skip_rows=3",))
case(
    "lines above with as many cells",
    written("Serial;4711;\nOperator;Smith;\n\n" + table(**DE)),
    notes="skip_rows = 3",
)
case(
    "comments above",
    written("; CSV, generated by a logger on 2024-07-24 18:29:57\n; Channels (6/16)\n" + table()),
    notes="skip_rows = 2",
)
case("comments with hashes", written("# made by a logger\n# rate: 50 Hz\n" + table()))
case("a header that is a comment", written("# run 3\n# " + table(sep=" ", head=("time", "F", "y"))))
case("a header behind a percent sign", written("% version 1.2\n% " + table(sep="   "), ".txt"))
case(
    "comments between rows",
    written("\n".join([*(rows := table().split("\n"))[:20], "# the lamp went on", *rows[20:]])),
    notes="1 line of comments",
)
case("empty lines", written("\n\n" + table().replace("\n0.4,", "\n\n0.4,")))
case("empty rows at the end", written(table(**DE) + ";;\n;;\n;;\n"))
case("a separator at the end of each row", written(table(head=("time", "F", "y", ""), after=",")))
case("units below the header", written(table().replace("time,F,y", "time,F,y\ns,N,m")))
case(
    "units in brackets below",
    written(table(sep=";", number=comma, y=MM).replace("time;F;y", "time;F;y\n[s];[N];[mm]")),
    notes="units: time s, F N, y mm",
)
case(
    "units below, lines above",
    written(PREAMBLE + table(sep=";", number=comma, y=MM).replace("time;F;y", "time;F;y\ns;N;mm")),
)
case(
    "groups above names above units",
    written(
        table(sep=";", y=MM).replace("time;F;y", "CAN 1;CAN 1;CAN 2\ntime;F;y\ns;N;mm"),
    ),
)
case(
    "units in the header",
    written(
        table(
            head=("time (ms)", "F / kN", "y in mm"),
            times=[plain(1e3 * t) for t in T],
            f=F / 1e3,
            y=MM,
        )
    ),
)
case(
    "a text column", written(table([f"ok,{plain(t)}" for t in T], head=("state", "time", "F", "y")))
)
case(
    "words where nothing was measured",
    written(table().replace(plain(Y[7]), "NaN", 1).replace("\n0.4,", "\n0.4,", 1)),
    y=np.where(
        np.arange(ROWS) == np.flatnonzero([plain(v) == plain(Y[7]) for v in Y])[0], np.nan, Y
    ),
)
case(
    "no header",
    written(table().split("\n", 1)[1]),
    edit=(
        ('"FILL IN: seconds between rows"', "0.02"),
        ('"FILL IN: a column"', '"column3"'),
        ("[[experiments]]", '[[experiments]]\ninputs.F = "column2"'),
    ),
    notes="no header",
)
case(
    "a last line that is cut off",
    written(table() + "1.2,0."),
    refused="must have 3 cells.*but row 62 has 2; cor",
)
case(
    "a first value that is no number",
    written(table().replace("\n0,0,", "\n0,OL,")),
    refused="column 'F', row 2: must be a number, but is 'OL'",
)
case("MDF that is called otherwise", written(b"MDF     4.10" * 9, ".dat"), refused="rename it")
case(
    "two tables below each other",
    written("a,b,c\n1,2,3\n4,5,6\n7,8,9\n\n" + table()),
    refused="headers in rows 1 and 6; choose one with skip_rows = 0 or skip_rows = 5",
)
case(
    "two tables below each other, said",
    written("a,b,c\n1,2,3\n4,5,6\n7,8,9\n\n" + table()),
    read=("skip_rows=5",),
)
case("a header that is too short", written(table(after=",7")), refused="header, but row 2 has 4")

# numbers
BIG = np.round(1e4 + 1e3 * F, 1)
case(
    "thousands of German",
    written(table(**(DE | {"f": BIG, "number": lambda n: _grouped(n, ".", ",")}))),
    f=BIG,
)
case(
    "thousands with blanks",
    written(table(**(DE | {"f": BIG, "number": lambda n: _grouped(n, " ", ",")}))),
    f=BIG,
)
case(
    "thousands with narrow blanks",
    written(table(**(DE | {"f": BIG, "number": lambda n: _grouped(n, "\u202f", ",")}))),
    f=BIG,
)
case(
    "thousands of Switzerland",
    written(table(f=BIG, sep=";", number=lambda n: _grouped(n, "'", "."))),
    f=BIG,
)
case(
    "thousands of English",
    written(table(f=BIG, sep="\t", number=lambda n: _grouped(n, ",", "."))),
    f=BIG,
)
case(
    "quoted thousands of English",
    written(table(f=BIG, number=lambda n: f'"{_grouped(n, ",", ".")}"')),
    f=BIG,
)
WHOLE = np.round(1e3 * F + 5e3)
AMBIGUOUS = table(
    [str(i) for i in range(1, ROWS + 1)],
    sep=";",
    f=WHOLE,
    y=np.ones(ROWS),
    number=lambda n: _grouped(n, ".", ","),
)
case(
    "thousands or decimals",
    written(AMBIGUOUS),
    refused=r'row \d+: .* may be a decimal.*decimal = "\."',
)
case(
    "thousands, said",
    written(AMBIGUOUS),
    t=np.arange(1.0, ROWS + 1),
    f=WHOLE,
    y=np.ones(ROWS),
    read=("decimal=,",),
)
case(
    "decimals, said",
    written(AMBIGUOUS),
    t=np.arange(1.0, ROWS + 1),
    f=WHOLE / 1e3,
    y=np.ones(ROWS),
    read=("decimal=.",),
)
case("a long minus", written(table().replace("-", "\u2212")))
case(
    "true and false",
    written(
        table(y=(Y > 0.05).astype(float)).replace(",1\n", ",True\n").replace(",0\n", ",False\n")
    ),
    y=(Y > 0.05).astype(float),
)

# times
case("milliseconds", written(table([plain(1e3 * t) for t in T], head=("time_ms", "F", "y"))))
case(
    "ISO",
    written(table(stamps("%Y-%m-%dT%H:%M:%S.{ms}"))),
    notes="from the first row, 2026-01-01 10",
)
case("ISO with a blank and a zone", written(table(stamps("%Y-%m-%d %H:%M:%S,{us}+01:00"), sep=";")))
case(
    "ISO of Greenwich",
    written(table(stamps("%Y-%m-%dT%H:%M:%S.{us}Z"), head=("Timestamp", "F", "y"))),
)
case(
    "German dates",
    written(table(stamps("%d.%m.%Y %H:%M:%S,{ms}"), **(DE | {"head": ("Zeit", *GERMAN[1:])}))),
)
case(
    "German dates of two digits",
    written(table(stamps("%d.%m.%y %H:%M:%S,{ms}"), **(DE | {"head": ("Datum", *GERMAN[1:])}))),
)
case("dates of MATLAB", written(table(stamps("%d-%b-%Y %H:%M:%S.{ms}"))))
case(
    "date and time apart",
    written(
        table(
            [
                f"{d};{c}"
                for d, c in zip(
                    stamps("%d.%m.%Y", 30000.0), stamps("%H:%M:%S", 30000.0), strict=True
                )
            ],
            **(DE | {"head": ("Datum", "Zeit", *GERMAN[1:])}),
        )
    ),
    t=30000.0 * np.arange(ROWS),
)
case(
    "time of day past midnight",
    written(table(stamps("%H:%M:%S.{ms}", start=dt.datetime(2026, 1, 1, 23, 59, 59, 500000)))),
    notes="past midnight",
)
case(
    "hours and minutes or minutes and seconds",
    written(table(stamps("%H:%M", 60.0))),
    refused='time_format = "%H:%M" or "%M:%S"',
)
case(
    "minutes and seconds",
    written(table([f"{int(2 * i) // 60:02d}:{2 * i % 60:02d}.5" for i in range(ROWS)])),
    t=2.0 * np.arange(ROWS),
)
US = stamps("%m/%d/%Y %I:%M:%S %p", 86400.0, dt.datetime(2026, 1, 5, 11, 30))
case("American dates that tell", written(table(US)), t=DAYS)
EITHER = stamps("%m/%d/%Y %H:%M:%S", 86400.0, dt.datetime(2024, 1, 2, 10))[:10]
FEW = {"f": F[:10], "y": Y[:10]}
case(
    "dates that are American or not",
    written(table(EITHER, **FEW)),
    refused='several ways.*time_format = "%d/%m/%Y %H:%M:%S" or "%m/%d/%Y %H:%M:%S"',
)
case(
    "American dates, said",
    written(table(EITHER, **FEW)),
    t=DAYS[:10],
    **FEW,
    read=("time_format=%m/%d/%Y %H:%M:%S",),
)
case(
    "British dates, said",
    written(table(EITHER, **FEW)),
    read=("time_format=%d/%m/%Y %H:%M:%S",),
    t=np.array(
        [(dt.datetime(2024, 2 + i, 1) - dt.datetime(2024, 2, 1)).days * 86400.0 for i in range(10)]
    ),
    **FEW,
)
case("dates of one day", written(table(stamps("%d/%m/%Y %H:%M:%S.{ms}"))), notes="the same seconds")
WINTER = [
    dt.datetime(2026, 10, 25, 0, 30, tzinfo=dt.UTC) + dt.timedelta(minutes=3 * i)
    for i in range(ROWS)
]
LOCAL = [when.astimezone(ZoneInfo("Europe/Berlin")) for when in WINTER]
NAIVE = table([w.strftime("%Y-%m-%d %H:%M:%S") for w in LOCAL])
case("clocks that go back", written(NAIVE), refused="summer time.*time_zone = ")
case(
    "clocks that go back, in Berlin",
    written(NAIVE),
    t=180.0 * np.arange(ROWS),
    read=("time_zone=Europe/Berlin",),
)
case(
    "clocks that go back, with zones",
    written(table([w.strftime("%Y-%m-%d %H:%M:%S %Z") for w in LOCAL])),
    t=180.0 * np.arange(ROWS),
)
SPRING = [
    (dt.datetime(2026, 3, 29, 0, 30, tzinfo=dt.UTC) + dt.timedelta(minutes=3 * i))
    .astimezone(ZoneInfo("Europe/Berlin"))
    .strftime("%Y-%m-%d %H:%M:%S")
    for i in range(ROWS)
]
case("clocks that go forward", written(table(SPRING)), refused="summer time.*time_zone = ")
case(
    "clocks that go forward, in Berlin",
    written(table(SPRING)),
    t=180.0 * np.arange(ROWS),
    read=("time_zone=Europe/Berlin",),
)
EPOCH = 1767261600
case(
    "seconds since 1970",
    written(table([f"{EPOCH + t:.3f}" for t in T])),
    notes="seconds since 1970",
)
case(
    "milliseconds since 1970",
    written(table([f"{EPOCH * 1000 + round(1e3 * t)}" for t in T])),
    notes="milliseconds since",
)
case(
    "milliseconds since 1970, with their unit",
    written(table([f"{EPOCH * 1000 + round(1e3 * t)}" for t in T], head=("time [ms]", "F", "y"))),
)
case(
    "milliseconds since 1970, called an epoch",
    written(table([f"{EPOCH * 1000 + round(1e3 * t)}" for t in T], head=("epoch_ms", "F", "y"))),
)
case(
    "microseconds since 1970",
    written(table([f"{EPOCH * 10**6 + round(1e6 * t)}" for t in T])),
    notes="microsec",
)
case(
    "nanoseconds since 1970",
    lambda folder: _arrow(
        folder, ".parquet", pa.array([EPOCH * 10**9 + round(1e9 * t) for t in T])
    ),
)

# many tests, long tables
RUNS = (
    "run,"
    + table().replace("\n", "\n1,", ROWS)
    + table().split("\n", 1)[1].replace("\n", "\n2,", ROWS - 1).join(["2,", ""])
)
case("two tests in one file", written(RUNS))
LONG = "time,signal,value\n" + "".join(
    f"{plain(t)},F,{plain(f)}\n{plain(t)},y,{plain(y)}\n" for t, f, y in zip(T, F, Y, strict=True)
)
case("a row for each value", written(LONG))
case(
    "a row for each value, two tests",
    written(
        "run,time,signal,value\n"
        + "".join(f"{r},{line}\n" for r in (1, 2) for line in LONG.split("\n")[1:-1])
    ),
)
case(
    "a row for each value, at two rates",
    written(
        "time,signal,value\n"
        + "".join(
            f"{plain(t)},F,{plain(f)}\n" + (f"{plain(t)},y,{plain(y)}\n" if i % 2 == 0 else "")
            for i, (t, f, y) in enumerate(zip(T, F, Y, strict=True))
        )
    ),
    y=Y[::2],
    ty=T[::2],
)
case(
    "two columns with times",
    written(
        "time;F;ty;y\n"
        + "".join(
            f"{plain(t)};{plain(f)};"
            + (f"{plain(T[2 * i])};{plain(Y[2 * i])}\n" if i < ROWS // 2 else ";\n")
            for i, (t, f) in enumerate(zip(T, F, strict=True))
        )
    ),
    y=Y[::2],
    ty=T[::2],
    edit=(('outputs.y = "y"', 'outputs.y = { column = "y", time = "ty" }'),),
)

# Arrow
case(
    "Parquet with times",
    lambda folder: _arrow(folder, ".parquet", pa.array(_instants(), pa.timestamp("us", "UTC"))),
)
case(
    "Feather with durations",
    lambda folder: _arrow(
        folder, ".feather", pa.array([dt.timedelta(seconds=float(t)) for t in T])
    ),
)


# MATLAB, HDF5, MDF, TDMS, Excel
def mat(content, **more):
    def make(folder):
        path = folder / "log.mat"
        savemat(path, content, **more)
        return path

    return make


case("MAT with vectors", mat({"time": T, "F": F, "y": Y}))
case("MAT with a structure", mat({"log": {"time": T, "F": F[:, None], "y": Y}}))
case(
    "MAT with a structure for each signal",
    mat({"F": {"Time": T, "Data": F}, "y": {"Time": T[::2], "Data": Y[::2]}}),
    y=Y[::2],
    ty=T[::2],
)
SIGNALS = np.array([(F, "F"), (Y, "y")], dtype=[("values", object), ("label", object)])
case(
    "MAT with Simulink's structure",
    mat({"log": {"time": T, "signals": SIGNALS}}),
    map=("F=log.signals[0].values", "y=log.signals[1].values"),
)
case(
    "MAT with a matrix",
    mat({"data": np.column_stack([T, F, Y])}),
    map=("time=data[0]", "F=data[1]", "y=data[2]"),
)
case("MAT 7.3", lambda folder: _mat73(folder))
case("HDF5 with groups", lambda folder: _hdf5(folder, grouped=True))
case("HDF5 with a table", lambda folder: _hdf5(folder, grouped=False))
case("MDF 4", lambda folder: _mdf(folder, 1))
case(
    "MDF 4 at two rates",
    lambda folder: _mdf(folder, 2),
    y=Y[::2],
    ty=T[::2],
    notes="2 different time channels",
)
case("TDMS with increments", lambda folder: _tdms(folder, "wave"))
case("TDMS with a channel of times", lambda folder: _tdms(folder, "channel"))
case("TDMS with timestamps", lambda folder: _tdms(folder, "stamps"))
case("xlsx", lambda folder: _xlsx(folder, {"Sheet1": [("time", "F", "y"), *_rows()]}))
case(
    "xlsx with lines above, units and dates",
    lambda folder: _xlsx(
        folder,
        {
            "Data": [
                ("Logger",),
                ("Serial", 4711),
                (),
                ("Zeit", "F", "y"),
                (None, "N", "mm"),
                *((START + dt.timedelta(seconds=float(t)), f, 1e3 * y) for t, f, y in _rows()),
            ]
        },
    ),
)
case(
    "xlsx with notes on a sheet",
    lambda folder: _xlsx(
        folder, {"Notes": [("made", "by hand")], "Data": [("time", "F", "y"), *_rows()]}
    ),
    notes='sheet "Data"',
)
TWO = {
    "A": [("time", "F", "y"), *((t, 2 * f, y) for t, f, y in zip(T, F, Y, strict=True))],
    "B": [("time", "F", "y"), *zip(T, F, Y, strict=True)],
}
case(
    "xlsx with two tables",
    lambda folder: _xlsx(folder, TWO),
    refused='several sheets.*as in sheet = "A"',
)
case("xlsx with two tables, said", lambda folder: _xlsx(folder, TWO), read=("sheet=B",))
case("xls", written(b"\xd0\xcf\x11\xe0" * 99, ".xls"), refused="must end in one of .csv")
case("MCAP", written(b"\x89MCAP0\r\n" * 9, ".mcap"), refused="must end in one of .csv")


def _instants():
    return [START.replace(tzinfo=dt.UTC) + dt.timedelta(seconds=float(t)) for t in T]


def _packed(folder):
    path = folder / "log.csv.gz"
    path.write_bytes(gzip.compress(table().encode()))
    return path


def _arrow(folder, ending, times):
    path = folder / f"log{ending}"
    content = pa.table({"time": times, "F": F, "y": Y})
    (pq.write_table if ending == ".parquet" else feather.write_feather)(content, path)
    return path


def _mat73(folder):
    """As MATLAB lays it out: dimensions turned round, its classes as attributes."""
    import h5py

    path = folder / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("log")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in (("time", T), ("F", F), ("y", Y)):
            group[name] = values[None, :]
            group[name].attrs["MATLAB_class"] = np.bytes_("double")
        group["note"] = np.frombuffer("run 3".encode("utf-16-le"), np.uint16)
        group["note"].attrs["MATLAB_class"] = np.bytes_("char")
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(head)
    return path


def _hdf5(folder, *, grouped):
    import h5py

    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        if grouped:
            for name, values, unit in (("time", T, "s"), ("F", F, "N"), ("y", MM, "mm")):
                file[f"bench/{name}"] = values
                file[f"bench/{name}"].attrs["unit"] = unit
        else:
            kinds = [("time", "f8"), ("F", "f4"), ("y", "f8")]
            file["log"] = np.array(list(zip(T, F, Y, strict=True)), kinds)
    return path


def _mdf(folder, rates):
    from asammdf import MDF, Signal

    path = folder / "log.mf4"
    with MDF(version="4.10") as file:
        if rates == 1:
            file.append([Signal(F, T, "N", "F"), Signal(MM, T, "mm", "y")])
        else:
            file.append([Signal(F, T, "N", "F")])
            file.append([Signal(MM[::2], T[::2], "mm", "y")])
        file.save(path, overwrite=True)
    return path


def _tdms(folder, kind):
    from nptdms import ChannelObject, TdmsWriter

    path = folder / "log.tdms"
    more = {"wf_increment": 0.02, "wf_start_offset": 0.0} if kind == "wave" else {}
    channels = [
        ChannelObject("bench", "F", F, more | {"unit_string": "N"}),
        ChannelObject("bench", "y", MM, more | {"unit_string": "mm"}),
    ]
    if kind == "channel":
        channels.append(ChannelObject("bench", "time", T))
    if kind == "stamps":
        when = np.datetime64("2026-01-01T10:00:00") + (1e6 * T).round().astype("timedelta64[us]")
        channels.append(ChannelObject("bench", "time", when))
    with TdmsWriter(path) as file:
        file.write_segment(channels)
    return path


def workbook(rows):
    """A file of Excel with one sheet."""
    return lambda folder: _xlsx(folder, {"Sheet1": rows})


def _xlsx(folder, sheets):
    import openpyxl

    path = folder / "log.xlsx"
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
    book.save(path)
    return path


def fmu_with_references(folder):
    """The spring's FMU with an experiment of FMI-LS-REF in its archive, at two rates."""
    path = folder / "spring.fmu"
    extra = "extra/org.fmi-standard.fmi-ls-ref/"
    manifest = (
        '<fmiReferences xmlns:fmi-ls="http://fmi-standard.org/fmi-ls-manifest" '
        'fmi-ls:fmi-ls-name="org.fmi-standard.fmi-ls-ref">'
        '<Related type="application/x-ma-hs-experiments" source="tests.exp" role="experiment"/>'
        '<Related type="text/plain" source="gone.txt" role="document"/></fmiReferences>'
    )
    experiments = (
        '<Experiments name="tests"><Experiment name="smoke" startTime="0" stopTime="1">'
        '<Stimuli source="in.csv"/><References source="out.csv"/></Experiment></Experiments>'
    )
    content = io.BytesIO(FMU.read_bytes())
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(extra + "fmi-ls-manifest.xml", manifest)
        archive.writestr(extra + "tests.exp", experiments)
        archive.writestr(
            extra + "in.csv", "time,F\n" + "".join(f"{t},{f}\n" for t, f in zip(T, F, strict=True))
        )
        archive.writestr(
            extra + "out.csv",
            "time,y\n" + "".join(f"{t},{y}\n" for t, y in zip(T[::2], Y[::2], strict=True)),
        )
    path.write_bytes(content.getvalue())
    return path


def petab_folder(folder):
    """Two conditions with the tables of PEtab."""
    tables = {
        "measurements.tsv": "observableId\tsimulationConditionId\ttime\tmeasurement\n"
        + "".join(
            f"{name}\t{condition}\t{plain(t)}\t{plain(v)}\n"
            for condition in ("soft", "stiff")
            for name, values in (("F", F), ("position", Y))
            for t, v in zip(T, values, strict=True)
        ),
        "conditions.tsv": "conditionId\tk\nsoft\t20\nstiff\t40\n",
        "observables.tsv": "observableId\tobservableFormula\tnoiseFormula\nposition\ty\t0.002\n",
        "parameters.tsv": "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\t"
        "estimate\n"
        "m\tlog10\t0.2\t5\t1.5\t1\nc\tlin\t0\t3\t0.7\t0\n",
    }
    for name, content in tables.items():
        (folder / name).write_text(content, encoding="utf-8")
    return folder
