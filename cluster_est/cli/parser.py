"""The arguments of every command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, get_args

from typing_extensions import override

from workers.effects.kinds import SiteKind
from workers.fmu.description import nearest

CODES_IN_WORDS = (
    "0 done; 1 done, but no solution was reached; 2 bad input; 3 a criterion of --fail-if is "
    "met; 130 interrupted"
)
FIRST_EXAMPLES = (
    "init model.fmu monday.csv tuesday.csv --out first.toml",
    "check first.toml",
    "fit first.toml --out runs/first",
    "close-loop first.toml --out runs/loop",
)
EXAMPLES = {
    "init": (
        "init model.fmu monday.csv tuesday.csv --out first.toml",
        "init model.fmu log.csv --map F='Load cell (kN)' --read decimal=, --out first.toml",
    ),
    "check": (
        "check first.toml",
        "check model.fmu",
        "check first.toml --seconds 60 --json --fail-if 'check_notes > 0'",
    ),
    "fit": (
        "fit first.toml --out runs/first",
        "fit first.toml --out runs/first --browser",
        "fit first.toml --out runs/far multistart.n=20 executor.workers=8",
        "fit first.toml --out runs/nightly --overwrite --fail-if 'rmse_test > 1.5 or too_narrow'",
    ),
    "close-loop": (
        "close-loop first.toml --out runs/loop",
        "close-loop first.toml --out runs/loop --browser",
        "close-loop first.toml --out runs/loop --resume --json --fail-if 'verdict != none'",
    ),
    "sensitivity": ("sensitivity first.toml --out runs/sensitivity",),
    "design": (
        "design runs/first --limits limits.toml --out next.csv",
        "design runs/first --limits limits.toml --out next.csv --predict tuesday",
    ),
    "simulate": (
        "simulate first.toml --out start.parquet",
        "simulate first.toml --out curves.csv --run runs/first",
    ),
    "show": (
        "show runs/first",
        "show runs/first --iterations",
        "show runs/first --json --fail-if 'parameters.k.value > 40'",
    ),
    "report": ("report runs/first", "report runs/first --out first.html"),
    "watch": (
        "watch runs/first",
        "watch runs/first --browser",
        "watch runs --browser --port 8765",
        "watch runs/first --html --every 5",
        "watch runs --json",
    ),
    "export": (
        "export runs/loop --fmu repaired.fmu",
        "export runs/first --ssv found.ssv --csv found.csv",
        "export runs/loop --modelica",
    ),
    "sweep": (
        "sweep sweep.toml --out runs/sweep",
        "sweep sweep.toml --out runs/sweep --retry-failed --fail-if 'worst_rmse_test > 1.5'",
    ),
    "replay": ("show runs/first --failures", "replay runs/first 17"),
    "forms": ("forms", "forms coulomb", "forms friction", "forms --site input"),
}
"""Lines for the help of each command."""


class UsageError(Exception):
    """Arguments that cannot be parsed.

    Parameters
    ----------
    said
        Description of the error.
    prog, usage
        Name and usage of the command, or of the program.
    """

    def __init__(self, said: str, prog: str, usage: str) -> None:
        super().__init__(said)
        self.prog, self.usage = prog, usage


class _Formatter(argparse.HelpFormatter):
    """Breaks lines between words, except for indented lines, which are examples."""

    @override
    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts = (
            line
            if line.startswith(" ")
            else super(_Formatter, self)._fill_text(line, width, indent)
            for line in text.splitlines()
        )
        return "\n".join(parts)


class _Parser(argparse.ArgumentParser):
    """A parser that raises an exception for wrong arguments."""

    def __init__(self, **how: Any) -> None:
        super().__init__(formatter_class=_Formatter, **how)

    @override
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, self.prog, self.format_usage())


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse arguments; key=value arguments may be anywhere, before and after the options."""
    parser = make_parser()
    _suggest(parser, sys.argv[1:] if arguments is None else arguments)
    options, rest = parser.parse_known_args(arguments)
    for argument in rest:
        if argument.startswith("-") or "=" not in argument or "overrides" not in options:
            parser.error(f"unrecognized argument: {argument}; write overrides as KEY=VALUE")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


class _ShowVersion(argparse.Action):
    """Print the name of the program and its version, which is determined only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        try:
            said = version("cluster-est")
        except PackageNotFoundError:
            said = "is run from a folder in which it is not installed"
        sys.stdout.write(f"{parser.prog} {said}\n")
        parser.exit()


def _suggest(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> None:
    """Exit with a suggestion if there is no command of that name."""
    known = parser.get_default("commands")
    name = next((each for each in arguments if not each.startswith("-")), None)
    if name is not None and name not in known:
        parser.error(f"there is no command {name!r}{nearest(name, known)}")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; `command` in its result is the name of the command."""
    parser = _Parser(
        prog="cluster-est",
        description="Estimate the parameters and initial states of an FMU from many measured "
        "experiments at once.",
        epilog=f"KEY=VALUE overrides a key of the config, as in method.options.trials=8.\n"
        f"Exit codes: {CODES_IN_WORDS}.\n\n{_listed(FIRST_EXAMPLES)}",
    )
    parser.add_argument("--version", action=_ShowVersion, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")

    _add_init(commands)
    check = _with_config(
        commands,
        "check",
        "find problems in a config, its data and its FMU, or in an FMU alone",
        config="the TOML file, or an FMU",
    )
    check.add_argument(
        "--seconds",
        type=_seconds,
        default=None,
        help="time in seconds for all checks together (default: 4); 0: only read everything",
    )
    for name, summary in (
        ("fit", "estimate the parameters"),
        ("close-loop", "search for effects that the model lacks, add them and fit again"),
        ("sensitivity", "rank the unknowns by their influence on the cost and the outputs"),
    ):
        command = _with_config(commands, name, summary)
        command.add_argument(
            "--out", type=Path, required=True, help="folder to which the run is written"
        )
        _add_existing(command)
    _add_design(commands)
    simulate = _with_config(
        commands,
        "simulate",
        "simulate every experiment, at the start values or with the estimates of a run",
    )
    simulate.add_argument(
        "--out", type=Path, required=True, help="table to write (.parquet, .feather or .csv)"
    )
    simulate.add_argument(
        "--run",
        dest="run_folder",
        type=Path,
        help="use the estimates of this run, and the effects that close-loop added",
    )
    show = _with_run(_command(commands, "show", "print a run's parameters and errors"))
    show.add_argument("--iterations", action="store_true", help="print the iteration table instead")
    show.add_argument("--failures", action="store_true", help="list failed simulations, for replay")
    show.add_argument(
        "--search",
        help="print the iteration table of this search, such as 'start 3'; default: "
        "the best search",
    )
    report = _command(
        commands,
        "report",
        "write the report of a run or a sweep: one HTML file that needs no network",
    )
    _with_run(report, "folder of the run or of the sweep")
    report.add_argument("--out", type=Path, help="file to write; default: RUN/report.html")
    _add_watch(commands)
    _add_export(commands)
    _add_sweep(commands)
    _add_replay(commands)
    _add_forms(commands)
    for command in commands.choices.values():
        _add_for_programs(command)
    parser.set_defaults(commands=tuple(commands.choices))
    return parser


Commands: TypeAlias = "argparse._SubParsersAction[_Parser]"


def _command(commands: Commands, name: str, summary: str) -> argparse.ArgumentParser:
    described = summary[0].upper() + summary[1:]
    examples = _listed(EXAMPLES[name])
    return commands.add_parser(name, help=summary, description=described, epilog=examples)


def _listed(examples: Sequence[str]) -> str:
    lines = (f"  cluster-est {each}" for each in examples)
    return "\n".join(["Examples:", *lines])


def _add_for_programs(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--json",
        action="store_true",
        help="print one JSON document with the same sentences and with all digits",
    )
    command.add_argument(
        "--fail-if",
        metavar="EXPRESSION",
        action="append",
        default=[],
        help="end with exit code 3 if this expression is true for the fields of the JSON document, "
        "as in --fail-if 'rmse_test > 1.5'; may be given several times",
    )


def _with_config(
    commands: Commands, name: str, summary: str, config: str = "the TOML file"
) -> argparse.ArgumentParser:
    command = _command(commands, name, summary)
    command.add_argument("config", metavar="CONFIG", type=Path, help=config)
    command.add_argument(
        "overrides", metavar="KEY=VALUE", nargs="*", help="override a key of the config"
    )
    _add_allow_code(command)
    return command


def _with_run(
    command: argparse.ArgumentParser, what: str = "folder of the run"
) -> argparse.ArgumentParser:
    command.add_argument("run_folder", metavar="RUN", type=Path, help=what)
    return command


def _add_init(commands: Commands) -> None:
    init = _command(commands, "init", "write a first config for an FMU and measured tables")
    init.add_argument("fmu", metavar="FMU", type=Path, help="the model")
    init.add_argument(
        "data",
        metavar="DATA",
        type=Path,
        nargs="*",
        help="tables, one for each experiment (.csv, .parquet, .feather, .mat, and with "
        "cluster-est[files] .h5, .mf4, .tdms, .xlsx), of which the last is held out if there "
        "are several; or a folder of PEtab-like tables; default: the reference results in the "
        "FMU",
    )
    init.add_argument(
        "--read",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="how to read the tables: encoding, skip_rows, decimal, sheet, time_format, "
        "time_zone or missing, as in --read encoding=cp1252; may be given several times",
    )
    init.add_argument(
        "--map",
        metavar="VARIABLE=COLUMN",
        action="append",
        default=[],
        help="column for a variable of the FMU, or for time, as in --map u='Voltage (V)'; may be "
        "given several times; default: columns are matched by name",
    )
    init.add_argument(
        "--out", type=Path, help="TOML file to write; default: the name of the FMU, in this folder"
    )
    init.add_argument("--overwrite", action="store_true", help="replace the file if it exists")


def _add_design(commands: Commands) -> None:
    summary = (
        "choose the input of the next experiment, to distinguish rival models or to reduce "
        "uncertainties"
    )
    design = _with_run(
        _command(commands, "design", summary), "folder of a run of fit or close-loop"
    )
    design.add_argument(
        "overrides",
        metavar="KEY=VALUE",
        nargs="*",
        help="override a key of executor, budget or log of the run",
    )
    design.add_argument(
        "--limits", type=Path, required=True, help="TOML file with the limits of the experiment"
    )
    design.add_argument(
        "--out",
        type=Path,
        required=True,
        help="table (.csv) to which the input is written; the run folder of the design has the "
        "same name without .csv",
    )
    design.add_argument(
        "--predict",
        metavar="EXPERIMENT[:OUTPUT,...]",
        action="append",
        default=[],
        help="experiment of the run whose outputs are to be predicted with small uncertainty; "
        "may be given several times",
    )
    _add_existing(design)
    _add_moved_config(design)


def _add_existing(command: argparse.ArgumentParser) -> None:
    present = command.add_mutually_exclusive_group()
    present.add_argument("--overwrite", action="store_true", help="replace the run in that folder")
    present.add_argument(
        "--resume",
        action="store_true",
        help="resume the interrupted run in that folder; start a new run if there is none",
    )
    command.add_argument("--no-report", action="store_true", help="do not write report.html")
    command.add_argument(
        "--browser",
        action="store_true",
        help="show the run in a browser while it is running, at an address that only this machine "
        "can reach",
    )


def _add_watch(commands: Commands) -> None:
    summary = (
        "follow a run from another terminal or machine, through its folder; with --json, print its "
        "state once"
    )
    watch = _with_run(
        _command(commands, "watch", summary), "folder of a run; with --browser or --json, of runs"
    )
    how = watch.add_mutually_exclusive_group()
    how.add_argument("--html", action="store_true", help="also keep RUN/report.html up to date")
    how.add_argument(
        "--browser",
        action="store_true",
        help="serve a page with cost, parameters, curves, workers and failures until Ctrl-C, at an "
        "address that only this machine can reach; for a folder of runs, the page shows all "
        "of them",
    )
    watch.add_argument(
        "--port",
        type=_port,
        default=0,
        help="port of the page that --browser serves; default: any free port",
    )
    watch.add_argument(
        "--every",
        metavar="SECONDS",
        type=_period,
        default=1.0,
        help="seconds between two updates (default: 1)",
    )
    _add_moved_config(watch)


def _add_sweep(commands: Commands) -> None:
    sweep = _command(commands, "sweep", "do all runs of a sweep that have not been done yet")
    sweep.add_argument("sweep", metavar="SWEEP", type=Path, help="the TOML file of the sweep")
    sweep.add_argument(
        "--out", type=Path, required=True, help="folder that contains a run folder for each run"
    )
    sweep.add_argument(
        "--retry-failed",
        action="store_true",
        help="repeat failed runs, even if nothing has changed",
    )
    _add_allow_code(sweep)


def _add_replay(commands: Commands) -> None:
    summary = "repeat one logged simulation and show the messages of the FMU"
    replay = _with_run(_command(commands, "replay", summary))
    replay.add_argument(
        "number",
        metavar="ID",
        type=int,
        help="row of the simulation in the log, counted from 0; see show RUN --failures",
    )
    _add_moved_config(replay)


def _add_export(commands: Commands) -> None:
    summary = "write the results of a run: a repaired FMU, a parameter set, or equations"
    export = _with_run(_command(commands, "export", summary))
    export.add_argument(
        "--fmu", type=Path, help="write the FMU with the estimates and effects in it (.fmu)"
    )
    export.add_argument(
        "--no-step",
        action="store_true",
        help="skip the search for a communication step that reproduces the error of the run; this "
        "search takes some seconds",
    )
    export.add_argument("--ssv", type=Path, help="write the values as an SSP parameter set (.ssv)")
    export.add_argument(
        "--csv", type=Path, help="write the values as a table: name, value, unit, interval (.csv)"
    )
    export.add_argument(
        "--modelica", action="store_true", help="print the effects as Modelica equations"
    )
    export.add_argument("--text", action="store_true", help="print values and effects as text")
    export.add_argument(
        "--experiment",
        metavar="ID",
        help="id of the experiment whose values are used, for parameters that have a value for "
        "each experiment",
    )
    _add_moved_config(export)


def _add_forms(commands: Commands) -> None:
    summary = "list the forms of effects, with their sites and coefficients"
    forms = _command(commands, "forms", summary)
    one = "describe this form, with a block for a config; or list the forms on a word, as friction"
    forms.add_argument("form", metavar="FORM", nargs="?", help=one)
    kinds = get_args(SiteKind)
    forms.add_argument("--site", choices=kinds, help="list only forms for this kind of site")


def _add_moved_config(command: argparse.ArgumentParser) -> None:
    command.add_argument("--config", type=Path, help="config of the run, if it has been moved")
    _add_allow_code(command)


def _add_allow_code(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--allow-code",
        action="store_true",
        help="allow Python functions in the config to run, on this machine and on the workers",
    )


def _seconds(text: str) -> float:
    seconds = float(text)
    if seconds != 0.0 and not 0.5 <= seconds < 1e6:
        raise argparse.ArgumentTypeError(f"must be 0, or a number of at least 0.5, but is {text}")
    return seconds


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port < 2**16:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 65535, but is {text}")
    return port


def _period(text: str) -> float:
    seconds = float(text)
    if not 0.1 <= seconds < 1e5:
        raise argparse.ArgumentTypeError(f"must be a number from 0.1 to 100000, but is {text}")
    return seconds
