"""More files as loggers write them, of the kinds that are met less often."""

import gzip
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.sparse import csc_array
from support.logger_files import (
    DE,
    EPOCH,
    MM,
    ROWS,
    START,
    Case,
    F,
    T,
    Y,
    _xlsx,
    comma,
    mat,
    plain,
    stamps,
    table,
    written,
)

ODD_CASES: list[Case] = []


def case(name, make, **more):
    ODD_CASES.append(Case(name, make, **more))


BODY = table().split("\n", 1)[1]
HALF = ROWS // 2


def rows(line):
    """A text with a line for each row of the test."""
    return "\n".join(line(i, T[i], F[i], Y[i]) for i in range(ROWS)) + "\n"


# around the table
case("Excel's line on the separator", written("sep=;\n" + table(**DE)))
case("the same behind a mark", written("\ufeffsep=;\r\n" + table(**DE, end="\r\n")))
case("a summary below", written(table() + "\nMaximum,3,0.09\nSamples: 60\n"))
case("an end mark", written(table() + "*** end of file ***\n"))
case("the header once more", written(table().replace("\n0.4,", "\ntime,F,y\n0.4,", 1)))
case("zeros where the power failed", written(table() + "\0" * 512))
case("lines of an old Macintosh", written(table(end="\r")))
case(
    "blocks of gnuplot",
    written("# time F y\n" + BODY.replace(",", " ").replace("\n0.4 ", "\n\n\n0.4 "), ".dat"),
)
case(
    "names of rows of R",
    written(
        "time F y\n" + rows(lambda i, t, f, y: f'"{i + 1}" {plain(t)} {plain(f)} {plain(y)}'),
        ".txt",
    ),
)
case(
    "an empty first column",
    written(",time,F,y\n" + rows(lambda i, t, f, y: f",{plain(t)},{plain(f)},{plain(y)}")),
)
case(
    "an index of pandas",
    written(",time,F,y\n" + rows(lambda i, t, f, y: f"{i},{plain(t)},{plain(f)},{plain(y)}")),
)
case(
    "numbers of rows",
    written(
        "No.;time;F;y\n" + rows(lambda i, t, f, y: f"{i + 1};{plain(t)};{plain(f)};{plain(y)}")
    ),
)
case(
    "padded cells",
    written("time ; F ; y\n" + rows(lambda i, t, f, y: f"{t:8.3f} ; {f:8.3f} ; {y:8.4f} ")),
)
case(
    "a header over two lines",
    written('"time\n[s]","F\n[N]","y\n[mm]"\n' + table(y=MM).split("\n", 1)[1]),
)
case(
    "commas in the header",
    written('"time, s","force, measured: F [N]",y\n' + BODY),
    map=("F=force, measured: F [N]",),
)
case(
    "the same name twice",
    written(
        "time,F,y,y\n" + rows(lambda i, t, f, y: f"{plain(t)},{plain(f)},{plain(y)},{plain(2 * y)}")
    ),
    refused="y",
)
case(
    "Campbell's header",
    written(
        '"TOA5","st","CR1000","1","std","CPU:a.CR1","2","t"\n"TIMESTAMP","RECORD","F","y"\n"TS","RN","N","m"\n"","","Smp","Smp"\n'
        + "".join(
            f'"{s}",{i},{plain(F[i])},{plain(Y[i])}\n'
            for i, s in enumerate(stamps("%Y-%m-%d %H:%M:%S.{ms}"))
        ),
        ".dat",
    ),
)
case(
    "LabVIEW's measurement file",
    written(
        "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n***End_of_Header***\t\n\t\nChannels\t2\nY_Unit_Label\tN\tm\nX0\t0\t0\nDelta_X\t0.02\t0.02\n***End_of_Header***\n"
        "X_Value\tF\ty\tComment\n"
        + rows(lambda i, t, f, y: f"{plain(t)}\t{plain(f)}\t{plain(y)}\t"),
        ".lvm",
    ),
)
case("PicoScope", written("Time,F,y\n(s),(N),(mm)\n\n" + table(y=MM).split("\n", 1)[1]))
case(
    "units as words",
    written(
        "x-axis,F,y\nsecond,Newton,Meter\n" + BODY,
    ),
    map=("time=x-axis",),
)
case(
    "Catman",
    written(
        "HBM_CATMAN\t5.4\nGerät: QuantumX\tSN 4711\n\nZeit\tF\ty\ns\tN\tmm\n"
        + table(sep="\t", number=comma, y=MM).split("\n", 1)[1],
        ".txt",
        "cp1252",
    ),
)
case(
    "a start and an increment",
    written(
        "X,F,y,Start,Increment\nSequence,N,m,0,0.02\n"
        + rows(lambda i, t, f, y: f"{i},{plain(f)},{plain(y)},,")
    ),
    refused="",
)
case(
    "an oscilloscope's columns beside",
    written(
        "\n".join(
            f"{('Record Length', 'Sample Interval', 'Trigger')[i] if i < 3 else ''},{(60, 0.02, 0)[i] if i < 3 else ''},,{plain(T[i])},{plain(F[i])},{plain(Y[i])}"
            for i in range(ROWS)
        )
        + "\n"
    ),
    refused="",
)

# cells
case(
    "a decimal comma in quotes",
    written("time,F,y\n" + rows(lambda i, t, f, y: f'"{comma(t)}","{comma(f)}","{comma(y)}"')),
)
case(
    "units in the cells",
    written(
        "time,F,y\n" + rows(lambda i, t, f, y: f"{plain(t)} s,{plain(f)} N,{plain(1e3 * y)} mm")
    ),
    refused="",
)
case(
    "plus signs and large exponents",
    written("time,F,y\n" + rows(lambda i, t, f, y: f"{t:+.3E},{f:+.3E},{y:+.3E}")),
)
case(
    "exponents of Fortran",
    written(
        "time F y\n" + rows(lambda i, t, f, y: f"{t:.4E} {f:.4E} {y:.4E}".replace("E", "D")), ".txt"
    ),
)
case(
    "apostrophes between thousands",
    written(
        "time;F;y\n"
        + rows(lambda i, t, f, y: f"{plain(t)};{1e4 * f:,.1f};{plain(y)}".replace(",", "'"))
    ),
    f=np.round(1e4 * F, 1),
)
case(
    "thin spaces between thousands",
    written(
        "time;F;y\n"
        + rows(lambda i, t, f, y: f"{plain(t)};{1e4 * f:,.1f};{plain(y)}".replace(",", "\u202f"))
    ),
    f=np.round(1e4 * F, 1),
)
KNOWN = np.where(np.arange(ROWS) == 7, np.nan, Y)
for word in (
    "n/a",
    "--",
    "***",
    "1.#QNAN",
    "-1.#IND",
    "#DIV/0!",
    "#WERT!",
    "OVER",
    "OVLD",
    "Bad",
    "I/O Timeout",
    "No Data",
    "undefined",
    "?",
):
    case(
        f"{word} where nothing was measured",
        written(
            "time,F,y\n"
            + rows(lambda i, t, f, y, w=word: f"{plain(t)},{plain(f)},{w if i == 7 else plain(y)}")
        ),
        y=KNOWN,
    )
case(
    "1.#INF",
    written(
        "time,F,y\n"
        + rows(lambda i, t, f, y: f"{plain(t)},{plain(f)},{'1.#INF' if i == 7 else plain(y)}")
    ),
    refused="",
)
case(
    "hexadecimal numbers",
    written("time,F,y\n" + rows(lambda i, t, f, y: f"{plain(t)},0x{i:02X},{plain(y)}")),
    refused="",
)
case(
    "on and off",
    written(
        "time,F,y\n" + rows(lambda i, t, f, y: f"{plain(t)},{'ON' if f > 0 else 'OFF'},{plain(y)}")
    ),
    refused="",
)
case(
    "TRUE and FALSE of Excel",
    written(
        "time;F;y\n"
        + rows(lambda i, t, f, y: f"{comma(t)};{'TRUE' if f > 0 else 'FALSE'};{comma(y)}")
    ),
    f=(F > 0) * 1.0,
)
case(
    "per cent",
    written("time,F,y\n" + rows(lambda i, t, f, y: f"{plain(t)},{plain(f)},{plain(100 * y)}%")),
    refused="",
)
case(
    "the name in each cell",
    written(rows(lambda i, t, f, y: f"t={plain(t)}, F={plain(f)}, y={plain(y)}"), ".txt"),
    refused="",
)
case(
    "the name before a colon in each cell",
    written(rows(lambda i, t, f, y: f"t:{plain(t)}\tF:{plain(f)}\ty:{plain(y)}"), ".txt"),
    refused="",
)
case(
    "a serial monitor's times",
    written(
        "\n".join(
            f"{s} -> {plain(F[i])},{plain(Y[i])}" for i, s in enumerate(stamps("%H:%M:%S.{ms}"))
        ),
        ".txt",
    ),
    refused="",
)
case(
    "one row for each signal",
    written(
        "time,"
        + ",".join(map(plain, T))
        + "\nF,"
        + ",".join(map(plain, F))
        + "\ny,"
        + ",".join(map(plain, Y))
        + "\n"
    ),
    refused="",
)

# times
case("seven decimals of .NET", written(table(stamps("%Y-%m-%dT%H:%M:%S.{us}0+01:00"))))
case("nine decimals", written(table(stamps("%Y-%m-%dT%H:%M:%S.{us}000Z"))))
case("names of days", written(table(stamps("%a %d %b %Y %H:%M:%S.{ms}"))))
case("ctime", written(table(stamps("%a %b %d %H:%M:%S %Y", 1.0))), t=np.arange(60.0))
case("compact dates", written(table(stamps("%Y%m%d %H%M%S.{ms}"))))
case("compact ISO", written(table(stamps("%Y%m%dT%H%M%S.{ms}Z"))))
case("slashes and ISO order", written(table(stamps("%Y/%m/%d %H:%M:%S.{ms}"))))
case("colons before the decimals", written(table(stamps("%Y-%m-%d %H:%M:%S:{ms}"))))
case("brackets around times", written(table(stamps("[%Y-%m-%d %H:%M:%S.{ms}]"))))
case("days of the year", written(table(stamps("%Y-%j %H:%M:%S.{ms}"))), refused="")
case("UTC behind", written(table(stamps("%Y-%m-%d %H:%M:%S.{ms} UTC"))))
case("durations", written(table(stamps("%H:%M:%S.{ms}", start=START.replace(hour=0)))))
case(
    "durations of days",
    written(table([f"0 days {s}" for s in stamps("%H:%M:%S.{us}", start=START.replace(hour=0))])),
)
case(
    "durations of an hour and more",
    written(table([f"{27 + i // 60}:{i % 60:02d}:00" for i in range(ROWS)])),
    t=60.0 * np.arange(ROWS),
)
case("seconds since 1904", written(table([f"{EPOCH + 2082844800 + t:.3f}" for t in T])))
case(
    "days of Excel",
    written(table([f"{46023.4 + t / 86400:.12f}" for t in T], head=("Date", "F", "y"))),
    refused="days|factor",
)
case(
    "days of MATLAB",
    written(table([f"{739988.4 + i:.1f}" for i in range(ROWS)], head=("datenum", "F", "y"))),
    refused="",
)
case(
    "ticks of Windows",
    written(table([str(134116956000000000 + round(1e7 * t)) for t in T])),
    refused="",
)
case("several rows in a second", written(table(stamps("%Y-%m-%d %H:%M:%S"))), refused="")
case("before the trigger", written(table([plain(t - 0.2) for t in T])), t=T - 0.2)
case(
    "milliseconds in whole numbers",
    written(table([str(round(1e3 * t)) for t in T], head=("Time_ms", "F", "y"))),
)
case(
    "microseconds of a microcontroller",
    written(table([str(round(1e6 * t)) for t in T], head=("micros", "F", "y"))),
    refused="",
)
case(
    "milliseconds of a microcontroller",
    written(table([str(round(1e3 * t)) for t in T], head=("millis", "F", "y"))),
)
case("elapsed", written(table(head=("Elapsed Time (s)", "F", "y"))))
case("relative time", written(table(head=("t_rel/s", "F", "y"))))
case(
    "newest first",
    written("time,F,y\n" + "\n".join(reversed(BODY.strip().split("\n"))) + "\n"),
    refused="",
)

# containers
case("a zip with a table", lambda folder: _zip(folder), refused="")
case("packed tabs", lambda folder: _gz(folder))
case("xls", written(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(512), ".xls"), refused="xlsx")
case("ods", written(b"PK\x03\x04mimetypeapplication/vnd.oasis", ".ods"), refused="must end in|xlsx")
case(
    "JSON lines",
    written(rows(lambda i, t, f, y: f'{{"time": {t}, "F": {f}, "y": {y}}}'), ".jsonl"),
    refused="must end in",
)
case(
    "JSON that is called otherwise",
    written(rows(lambda i, t, f, y: f'{{"time": {t}, "F": {f}, "y": {y}}}'), ".txt"),
    refused="",
)
case(
    "XML that is called otherwise",
    written(
        "<?xml version='1.0'?><log>"
        + rows(lambda i, t, f, y: f"<r t='{t}' F='{f}' y='{y}'/>")
        + "</log>",
        ".txt",
    ),
    refused="",
)
case(
    "HTML of a spreadsheet",
    written(
        "<html><table>"
        + rows(lambda i, t, f, y: f"<tr><td>{t}</td><td>{f}</td></tr>")
        + "</table></html>",
        ".csv",
    ),
    refused="",
)
case("xlsx that is called csv", lambda folder: _renamed(folder), refused="xlsx")
case(
    "a CAN trace",
    written(
        "date Thu Jan 1 10:00:00 2026\nbase hex  timestamps absolute\n"
        + rows(
            lambda i, t, f, y: (
                f"   {t:.6f} 1  123             Rx   d 8 01 02 03 04 05 06 07 {i:02X}"
            )
        ),
        ".asc",
    ),
    refused="",
)
case("a binary file", written(bytes(range(256)) * 8, ".dat"), refused="")
case("a parquet of decimals and words", lambda folder: _parquet(folder))
case(
    "xlsx with numbers as text",
    lambda folder: _xlsx(
        folder,
        {
            "A": [
                ("time", "F", "y"),
                *((plain(t), plain(f), plain(y)) for t, f, y in zip(T, F, Y, strict=True)),
            ]
        },
    ),
)
case(
    "xlsx with an empty first column and row",
    lambda folder: _xlsx(
        folder,
        {
            "A": [
                (),
                (None, "time", "F", "y"),
                *((None, float(t), float(f), float(y)) for t, f, y in zip(T, F, Y, strict=True)),
            ]
        },
    ),
)
case(
    "xlsx with a title and units",
    lambda folder: _xlsx(
        folder,
        {
            "A": [
                ("Test 3",),
                (),
                ("time", "F", "y"),
                ("s", "N", "mm"),
                *((float(t), float(f), float(y)) for t, f, y in zip(T, F, MM, strict=True)),
            ]
        },
    ),
)
case(
    "MAT with whole numbers and a row",
    mat({"time": np.arange(ROWS, dtype=np.int32) * 20, "F": F[None, :].astype(np.float32), "y": Y}),
    t=20.0 * np.arange(ROWS),
    f=F.astype(np.float32).astype(float),
)
case("MAT with logicals", mat({"time": T, "F": F > 0, "y": Y}), f=(F > 0) * 1.0)
case(
    "MAT with cells and text beside",
    mat({"time": T, "F": F, "y": Y, "names": np.array(["a", 1], object), "who": "me"}),
)
case("MAT with a sparse column", mat({"time": T, "F": F, "y": csc_array(Y[:, None])}), refused="")
case("MAT with complex numbers", mat({"time": T, "F": F, "y": Y + 1j}), refused="")
case("MAT of version 4", mat({"time": T, "F": F, "y": Y}, format="4"))


def _zip(folder):
    path = folder / "log.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("log.csv", table())
    return path


def _gz(folder):
    path = folder / "log.csv.gz"
    path.write_bytes(gzip.compress(table(**(DE | {"sep": "\t"})).encode()))
    return path


def _renamed(folder):
    path = _xlsx(folder, {"A": [("time", "F", "y"), (0.0, 1.0, 2.0)]})
    return path.rename(path.with_suffix(".csv"))


def _parquet(folder):
    from decimal import Decimal

    path = folder / "log.parquet"
    given = pa.table(
        {
            "time": T,
            "F": pa.array([Decimal(plain(f)).quantize(Decimal("0.001")) for f in F]),
            "y": pa.array(Y.astype(np.float64)),
            "state": pa.array(["on"] * ROWS).dictionary_encode(),
        }
    )
    pq.write_table(given, path)
    return path
