"""More files as loggers write them, of the kinds that are met less often.

`said` stands in place of the numbers where a file cannot be read as it is: what `init`, its config
or `check` says to do.
"""

import gzip
import zipfile
from decimal import Decimal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat
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
    comma,
    mat,
    plain,
    stamps,
    table,
    workbook,
    written,
)

ODD_CASES: list[Case] = []


def case(name, make, **more):
    ODD_CASES.append(Case(name, make, **more))


def rows(form, *, number=plain, **more):
    """A line for each row; in the form {t}, {f}, {y} are texts, and {i} counts from 1."""
    others = {name: list(values) for name, values in more.items()}
    return "".join(
        form.format(
            i=i + 1,
            t=number(T[i]),
            f=number(F[i]),
            y=number(Y[i]),
            **{name: values[i] for name, values in others.items()},
        )
        + "\n"
        for i in range(ROWS)
    )


def text(form, head="time,F,y\n", ending=".csv", below="", **more):
    return written(head + rows(form, **more) + below, ending)


def at_times(times, head="time"):
    return written(table(list(times), head=(head, "F", "y")))


LINE = "{t},{f},{y}"
MIDNIGHT = START.replace(hour=0)

# around the table
case("Excel's line on the separator", written("sep=;\n" + table(**DE)))
case("the same behind a mark", written("\ufeffsep=;\r\n" + table(**DE, end="\r\n")))
SUMMARY = "\nMaximum,3,0.09\nSamples: 60\n"
case("a summary below", text(LINE, below=SUMMARY), notes="below its table are ignored: 2 lines")
case(
    "an end mark",
    text(LINE, below="*** end of file ***\n"),
    notes="below its table are ignored: 1 line",
)
case(
    "zeros where the power failed",
    text(LINE, below="\0" * 512),
    notes="below its table are ignored: zeros",
)
case("an end mark behind blanks", text("{t} {f} {y}", "time F y\n", ".prn", "END\n"))
case(
    "the header once more",
    written(table().replace("\n0.4,", "\ntime,F,y\n0.4,", 1)),
    said="has several, with headers in rows 1 and 22; choose one with skip_rows",
)
case("lines of an old Macintosh", written(table(end="\r")))
case("blocks of gnuplot", written("# time F y\n" + rows("{t} {f} {y}\n"), ".dat"))
case("names of rows of R", text('"{i}" {t} {f} {y}', "time F y\n", ".txt"))
case("names of rows of R, with commas", text('"{i}",{t},{f},{y}'))
case("an empty first column", text(",{t},{f},{y}", ",time,F,y\n"))
case("an index of pandas", text("{i},{t},{f},{y}", ",time,F,y\n"))
case("numbers of rows", text("{i};{t};{f};{y}", "No.;time;F;y\n"))
case("padded cells", text("  {t} ; {f}  ;  {y} ", "time ; F ; y\n"))
case("a header over two lines", text(LINE, '"time\n[s]","F\n[N]","y\n[m]"\n'))
FORCE = "force, measured: F [N]"
case("commas in the header", text(LINE, f'time,"{FORCE}",y\n'), map=(f"F={FORCE}",))
case(
    "the same name twice",
    text("{t},{f},{y},{y}", "time,F,y,y\n"),
    said="column 'y' must occur once, but 2 columns have that name; rename them",
)
CAMPBELL = (
    '"TOA5","st","CR1000","1","std","CPU:a.CR1","2","t"\n"TIMESTAMP","RECORD","F","y"\n'
    '"TS","RN","N","mm"\n"","","Smp","Smp"\n'
)
STAMPS = stamps("%Y-%m-%d %H:%M:%S.{ms}")
case("Campbell's header", text('"{s}",{i},{f},{m}', CAMPBELL, ".dat", s=STAMPS, m=map(plain, MM)))
LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\t\n\t\n"
    "Channels\t2\nDelta_X\t0.02\t0.02\n***End_of_Header***\nX_Value\tF\ty\tComment\n"
)
case("LabVIEW's measurement file", text("{t}\t{f}\t{y}\t", LABVIEW, ".lvm"))
case("PicoScope", text("{t},{f},{m}", "Time,F,y\n(s),(N),(mm)\n\n", m=map(plain, MM)))
WORDS = "x-axis,F,y\nsecond,Newton,Meter\n"
case("units as words", text(LINE, WORDS), map=("time=x-axis",), notes="x-axis s, F N, y m")
CATMAN = "CATMAN\t5.4\nGerät: Q\tSN 4711\n\nZeit\tF\ty\ns\tN\tm\n"
case("Catman", written(CATMAN + rows("{t}\t{f}\t{y}", number=comma), ".txt", "cp1252"))

# cells
case("a decimal comma in quotes", text('"{t}","{f}","{y}"', number=comma))
case("units in the cells", text("{t} s,{f} N,{y} m"), said="has none .'time' holds '0 s'.")
case("plus signs and large exponents", text(LINE, number="{:+.5E}".format))
case(
    "exponents of Fortran",
    text("{t} {f} {y}", "time F y\n", ".txt", number=lambda x: f"{x:.5E}".replace("E", "D")),
)
LARGE = np.round(1e4 * F, 1)
for name, sign in (("apostrophes", "'"), ("thin blanks", "\u202f"), ("blanks", " ")):
    grouped = [f"{f:,.1f}".replace(",", sign) for f in LARGE]
    case(f"{name} between thousands", text("{t};{g};{y}", "time;F;y\n", g=grouped), f=LARGE)
KNOWN = np.where(np.arange(ROWS) == 7, np.nan, Y)
for word in ("n/a", "***", "-1.#IND", "#DIV/0!", "#WERT!", "Bad", "I/O Timeout", "No Data", "?"):
    cells = [word if i == 7 else plain(y) for i, y in enumerate(Y)]
    case(f"{word} where nothing was measured", text("{t},{f},{c}", c=cells), y=KNOWN)
for word in ("OVER", "OL", "1.#INF"):
    cells = [word if i == 7 else plain(y) for i, y in enumerate(Y)]
    case(
        f"{word} in a cell",
        text("{t},{f},{c}", c=cells),
        said=f"row 9: must be a number, but is '{word}'",
    )
PUSHED = (F > 0.0) * 1.0
case("on and off", text("{t},{c},{y}", c=["ON" if f else "Off" for f in PUSHED]), f=PUSHED)
case(
    "TRUE and FALSE of Excel",
    text("{t};{c};{y}", "time;F;y\n", number=comma, c=["TRUE" if f else "FALSE" for f in PUSHED]),
    f=PUSHED,
)
for on, off in (("Ein", "Aus"), ("an", "AUS"), ("wahr", "falsch"), ("Enabled", "disabled")):
    words = [on if f else off for f in PUSHED]
    case(f"{on} and {off}", text("{t},{c},{y}", c=words), f=PUSHED)
words = ["open" if f and i > 12 else "ON" for i, f in enumerate(PUSHED)]
case(
    "open and ON",
    text("{t},{c},{y}", c=words),
    said="must be a number, but is 'open'; .*on and off, true and false, ein and aus are read",
)
case("hexadecimal numbers", text("{t},0x{i:02X},{y}"), said="column 'F' holds '0x01'")
case("per cent", text("{t},{f},{y}%"), said="column 'y' holds '0.09%'")
case("the name in each cell", text("t={t}, F={f}, y={y}", "", ".txt"), said="holds 't=0.02'")

# times
case("seven decimals of .NET", at_times(stamps("%Y-%m-%dT%H:%M:%S.{us}0+01:00")))
case("nine decimals", at_times(stamps("%Y-%m-%dT%H:%M:%S.{us}000Z")))
case("names of days", at_times(stamps("%a %d %b %Y %H:%M:%S.{ms}")))
case("ctime", at_times(stamps("%a %b %d %H:%M:%S %Y", 1.0)), t=np.arange(60.0))
case("compact dates", at_times(stamps("%Y%m%d %H%M%S.{ms}")))
case("compact ISO", at_times(stamps("%Y%m%dT%H%M%S.{ms}Z")))
case("slashes and the order of ISO", at_times(stamps("%Y/%m/%d %H:%M:%S.{ms}")))
case("a colon before the decimals", at_times(stamps("%Y-%m-%d %H:%M:%S:{ms}")))
case("brackets around times", at_times(stamps("[%Y-%m-%d %H:%M:%S.{ms}]")))
case("days of the year", at_times(stamps("%Y-%j %H:%M:%S.{ms}")))
case("UTC behind", at_times(stamps("%Y-%m-%d %H:%M:%S.{ms} UTC")))
case("durations", at_times(stamps("%H:%M:%S.{ms}", start=MIDNIGHT)))
case("durations of pandas", at_times(stamps("0 days %H:%M:%S.{us}", start=MIDNIGHT)))
case(
    "durations of a day and more",
    at_times(f"{27 + i // 60}:{i % 60:02d}:00" for i in range(ROWS)),
    t=60.0 * np.arange(ROWS),
)
case(
    "seconds since 1904",
    at_times(str(EPOCH + 2082844800 + i) for i in range(ROWS)),
    t=np.arange(60.0),
)
FILE_TIME = 134116956000000000
case(
    "ticks of Windows",
    at_times(str(FILE_TIME + 10**7 * i) for i in range(ROWS)),
    t=np.arange(60.0),
    notes="units of 100 ns since 1601",
)
case(
    "days of Excel",
    at_times((f"{46023.4 + t / 86400:.12f}" for t in T), "Date"),
    said='time = "Date" # use this instead if it is the time',
)
case(
    "several rows in a second",
    at_times(stamps("%Y-%m-%d %H:%M:%S")),
    said="many rows have the same time, so give sample_time",
)
case(
    "newest first",
    written("time,F,y\n" + "\n".join(reversed(rows(LINE).split())) + "\n"),
    said="reverse the order of the rows",
)
case("before the trigger", at_times(plain(t - 0.2) for t in T), t=T - 0.2)
case("milliseconds of a controller", at_times((f"{1e3 * t:.0f}" for t in T), "millis"))
case("microseconds of a controller", at_times((f"{1e6 * t:.0f}" for t in T), "micros"))
case("milliseconds in a name", at_times((f"{1e3 * t:.0f}" for t in T), "Time_ms"))
case("elapsed", at_times(map(plain, T), "Elapsed Time (s)"))
case("relative", at_times(map(plain, T), "Relative Time [s]"))

# what is no text, or is called otherwise
BEGINS = {".xls": (b"\xd0\xcf\x11\xe0", "save it as .xlsx"), ".zip": (b"PK\3\4", "unpack it")}
for ending, (begin, said) in BEGINS.items():
    case(f"a file {ending}", written(begin + bytes(512), ending), said=f"must end in.*{said}")
JSON = '{{"time": {t}, "F": {f}, "y": {y}}}'
case("JSON", text(JSON, "", ".jsonl"), said="must end in.*save it as .csv")
case("JSON that is called otherwise", text(JSON, "", ".txt"), said="is JSON; save it as csv")
case("a page of a spreadsheet", text("<td>{t}</td>", "<html>\n"), said="is XML or HTML; save it")
case("a zip that is called csv", lambda folder: _zip(folder), said="is a .xlsx file; rename it")
CAN = "date Thu Jan 1 2026\nbase hex  timestamps absolute\n"
case("a CAN trace", text(" {t} 1 12x Rx d 8 0A", CAN, ".asc"), said="must have columns of numbers")
case("bytes", written(bytes(range(256)) * 8, ".dat"), said="must have a known encoding")
case("packed tabs", lambda folder: _packed(folder))
case("a parquet of decimals and words", lambda folder: _parquet(folder))
NUMBERS = [(float(t), float(f), float(y)) for t, f, y in zip(T, F, Y, strict=True)]
NAMES = ("time", "F", "y")
case("xlsx of text", workbook([NAMES, *(tuple(map(plain, row)) for row in NUMBERS)]))
SHIFTED = [(), (None, *NAMES), *((None, *row) for row in NUMBERS)]
case("xlsx with an empty first column and row", workbook(SHIFTED))
case("xlsx with a title and units", workbook([("Test 3",), (), NAMES, ("s", "N", "m"), *NUMBERS]))
case("MAT with logicals", mat({"time": T, "F": F > 0, "y": Y}), f=PUSHED)
SINGLE = F.astype(np.float32)
case("MAT with single numbers in a row", mat({"time": T, "F": SINGLE[None, :], "y": Y}), f=SINGLE)
BESIDE = {"names": np.array(["a", 1], object), "who": "me"}
case("MAT with cells and text beside", mat({"time": T, "F": F, "y": Y} | BESIDE))
case("MAT of version 4", mat({"time": T, "F": F, "y": Y}, format="4"))
SPARSE = mat({"time": T, "F": F, "y": csc_array(Y[:, None])})
case("MAT with a sparse column", SPARSE, said="column 'y' must be a vector.*is a sparse matrix")
COMPLEX = mat({"time": T, "F": F, "y": Y + 1j})
case("MAT with complex numbers", COMPLEX, said="column 'y' must be a vector.*complex")
SERIES = r"run this in MATLAB: y_s = struct\('Time', y.Time, 'Data', squeeze\(y.Data\)\)"
case("MAT with a timeseries", lambda folder: _with_object(folder, b"timeseries"), said=SERIES)
TIMETABLE = r"run this in MATLAB: writetimetable\(y, 'y.csv'\)"
case("MAT with a timetable", lambda folder: _with_object(folder, b"timetable"), said=TIMETABLE)
case("MAT 7.3 with a timetable", lambda folder: _mat73(folder), said=TIMETABLE)


def _zip(folder):
    path = folder / "log.csv"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("log.csv", table())
    return path


def _packed(folder):
    path = folder / "log.csv.gz"
    path.write_bytes(gzip.compress(table(**(DE | {"sep": "\t"})).encode()))
    return path


def _parquet(folder):
    path = folder / "log.parquet"
    given = {
        "time": T,
        "F": pa.array([Decimal(plain(f)).quantize(Decimal("0.001")) for f in F]),
        "y": Y,
        "state": pa.array(["on"] * ROWS).dictionary_encode(),
    }
    pq.write_table(pa.table(given), path)
    return path


def _with_object(folder, kind):
    """Beside vectors an object of a class of MATLAB's, as far as its name and class go."""
    path = folder / "log.mat"
    savemat(path, {"time": T, "F": F})
    texts = b"".join(
        np.array([1, len(each)], "<u4").tobytes() + each + bytes(-len(each) % 8)
        for each in (b"y", b"MCOS", kind)
    )
    body = np.array([6, 8, 17, 0], "<u4").tobytes() + texts
    path.write_bytes(path.read_bytes() + np.array([14, len(body)], "<u4").tobytes() + body)
    return path


def _mat73(folder):
    import h5py

    path = folder / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values, kind in (
            ("time", T, "double"),
            ("F", F, "double"),
            ("y", [1], "timetable"),
        ):
            file[name] = np.asarray(values)[None, :]
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path
