"""The model that a worker simulates: an FMU with effects, solver and reset policy."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import PurePosixPath
from typing import ClassVar, Self, get_args

from workers.errors import EffectError, ModelError
from workers.messages.checks import (
    as_pairs,
    as_tuple,
    check_choice,
    check_kind,
    check_name,
    check_number,
    check_text,
    few_names,
    shown,
)
from workers.messages.types import Interface, ResetPolicy, SolverName, content_hash


@dataclass(frozen=True)
class Seats:
    """The seats for instances of an FMU: each instance takes one as long as it exists.

    A seat must be taken before an instance is made (`workers.fmu.seats`). So the limit includes
    workers, probes, and replacements of killed processes.

    Attributes
    ----------
    program
        Identifies the program that owns the seats.
    numbers
        Seats that may be taken: all seats for a pool, one seat for each of its workers.
    """

    program: str
    numbers: tuple[int, ...]

    def of_worker(self, worker: int) -> Self:
        """Return the seat of a worker, which may have only one instance."""
        return replace(self, numbers=self.numbers[worker : worker + 1])


@dataclass(frozen=True)
class Solver:
    """The solver of a simulation, and its settings.

    Attributes
    ----------
    name
        "dormand_prince", "rk4" or, for stiff models, "cvode" for model exchange; "fmu" for
        co-simulation, in which the FMU contains its solver.
    step
        Seconds. The step of "rk4", the longest step of "dormand_prince" and "cvode", the longest
        communication step of "fmu". None: one step from each time in the data to the next ("rk4",
        "fmu"), no limit ("dormand_prince", "cvode").
    rtol, atol
        Tolerances of the error of one step; `atol` is in units of each state's nominal value.
        For "fmu", `rtol` is passed to the FMU; with None, the FMU uses its own tolerance.
    max_steps
        Number of steps between two times in the data above which a simulation fails.

    Raises
    ------
    ModelError
        If the name is unknown, or a number out of its range.
    """

    name: SolverName
    step: float | None = None
    rtol: float | None = None
    atol: float | None = None
    max_steps: int = 1_000_000

    def __post_init__(self) -> None:
        check_choice(self.name, get_args(SolverName), "model.solver", ModelError)
        for key, below in (("step", float("inf")), ("rtol", 1.0), ("atol", float("inf"))):
            value = getattr(self, key)
            if value is not None:
                check_number(value, f"model.{key}", ModelError, above=0.0, below=below)
        check_number(self.max_steps, "model.max_steps", ModelError, above=0, whole=True)


@dataclass(frozen=True)
class Effect:
    """A term that the model lacks, added around the FMU.

    Attributes
    ----------
    name
        Chosen by the user; its coefficients are called "NAME.COEFFICIENT".
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form
        Name of a form of the library; empty if `equation` is given.
    variables
        Arguments of the form: states, inputs and measured signals by name (at outputs also
        outputs), or the difference of two, "v - w".
    equation
        A user-defined equation in the FMU's names, `t`, `s` and `coefficients`.
    coefficients
        (name, neutral value) of the coefficients of `equation`; the neutral value is None for a
        shape parameter.
    reaction
        At a pair: the term that is added to the second state's derivative; `equation` is added to
        the first state's derivative.
    """

    NOISE: ClassVar[tuple[str, ...]] = ("diffusion", "coloured_noise")
    """The forms of process noise."""

    name: str
    site: str
    form: str = ""
    variables: tuple[str, ...] = ()
    equation: str = ""
    coefficients: tuple[tuple[str, float | None], ...] = ()
    reaction: str = ""

    @property
    def is_noise(self) -> bool:
        """Whether it is noise that acts on a state, which requires a Kalman filter."""
        return self.form in self.NOISE

    def __post_init__(self) -> None:
        check_name(self.name, "effect.name", EffectError)
        where = f"effect {self.name!r}"
        check_name(self.site, f"{where}.site", EffectError)
        named = as_tuple(self.variables, str, f"{where}.variables", EffectError)
        pairs = as_pairs(self.coefficients, f"{where}.coefficients", EffectError)
        object.__setattr__(self, "variables", named)
        object.__setattr__(self, "coefficients", pairs)
        for key in ("form", "equation", "reaction"):
            check_text(getattr(self, key), f"{where}.{key}", EffectError)
        for coefficient, neutral in pairs:
            if neutral is not None:
                check_number(neutral, f"{where}.coefficients.{coefficient}", EffectError)


@dataclass(frozen=True)
class Model:
    """The model that a worker simulates: an FMU and its solver.

    Attributes
    ----------
    name
        Name of the file, for messages.
    archive
        The bytes of the FMU, so that a worker on another machine needs no file.
    interface, solver
        The FMU's interface, and the solver.
    parameters
        Names of the variables whose values are in every task's `values`, in that order.
    structure
        (name, value) of structural parameters (FMI 3) that differ from their start values. They
        determine the sizes of arrays, so they are the same in all experiments.
    logging_on
        Whether the FMU logs everything that it can, and its messages are also written to stderr.
    reset
        The reset policy, which each simulation starts with. "reset" resets the existing instance.
        "instance" makes a new instance, for FMUs whose reset is incomplete. "process" starts a new
        process, for FMUs whose library keeps data. With "auto", the coordinator chooses; a worker
        resets.
    environment
        (name, value) of environment variables that the FMU needs, set before it is loaded.
    working_folder
        The folder in the FMU's archive, such as "resources", in which its process works. For an FMU
        that opens its files by relative paths. "" for the program's folder.
    stop_time
        Whether the FMU is given the stop time of a simulation. None: only if it cannot be
        initialised otherwise.
    seats
        Seats for its instances if their number is limited; None if it is not.

    Raises
    ------
    ModelError
        If it is no archive, or interface and solver are unknown or do not fit together.
    """

    name: str
    archive: bytes = field(repr=False)
    interface: Interface
    solver: Solver
    parameters: tuple[str, ...]
    structure: tuple[tuple[str, int], ...] = ()
    logging_on: bool = False
    reset: ResetPolicy = "auto"
    environment: tuple[tuple[str, str], ...] = ()
    working_folder: str = ""
    stop_time: bool | None = None
    seats: Seats | None = None

    def __repr__(self) -> str:
        named = few_names(self.parameters) or "no parameters"
        return f"Model({self.name}: {named}; {self.interface}, {self.solver.name})"

    def __post_init__(self) -> None:
        if isinstance(self.archive, str | PathLike):
            raise ModelError(
                "model.archive: must be the bytes of an FMU, but is the path "
                f"{shown(self.archive)}; use cluster_est.read_model(path)"
            )
        check_kind(self.archive, bytes, "model.archive", ModelError)
        check_choice(self.interface, get_args(Interface), "model.interface", ModelError)
        advice = f"; write Solver({self.solver!r})" if isinstance(self.solver, str) else ""
        check_kind(self.solver, Solver, "model.solver", ModelError, advice)
        check_choice(self.reset, get_args(ResetPolicy), "model.reset", ModelError)
        check_solver(self.interface, self.solver.name)
        named = as_tuple(self.parameters, str, "model.parameters", ModelError)
        object.__setattr__(self, "parameters", named)
        pairs = as_pairs(self.structure, "model.structure", ModelError)
        object.__setattr__(self, "structure", pairs)
        variables = as_pairs(self.environment, "model.environment", ModelError)
        object.__setattr__(self, "environment", variables)
        for name, value in variables:
            _check_variable(name, value)
        _check_folder(self.working_folder)
        if self.stop_time is not None:
            check_kind(self.stop_time, bool, "model.stop_time", ModelError)

    def at_most(self, workers: int) -> int:
        """Return how many of `workers` workers may have an instance at once."""
        return workers if self.seats is None else min(workers, len(self.seats.numbers))

    def of_worker(self, worker: int) -> Self:
        """Return the model of one of a pool's workers, counted from 0, with its own seat."""
        if self.seats is None:
            return self
        return replace(self, seats=self.seats.of_worker(worker))

    @cached_property
    def archive_hash(self) -> str:
        """SHA-256 of the FMU, the name of its unpacked folder."""
        return hashlib.sha256(self.archive).hexdigest()

    @cached_property
    def key(self) -> str:
        """Hash of everything that determines a simulation, except values and experiment."""
        more = [repr(self.structure)] if self.structure else []
        more += [f"renew {self.reset}"] if self.reset != "auto" else []
        more += [f"environment {self.environment!r}"] if self.environment else []
        more += [f"folder {self.working_folder}"] if self.working_folder else []
        more += [f"stop time {self.stop_time}"] if self.stop_time is not None else []
        return content_hash(
            [self.archive_hash, self.interface, repr(self.solver), *self.parameters, *more]
        )


def _check_variable(name: str, value: object) -> None:
    """Check that a system accepts an environment variable."""
    check_text(value, f"model.environment.{name}", ModelError)
    if not name or "=" in name or "\0" in f"{name}{value}":
        raise ModelError(
            "model.environment: names must not contain '=', and neither names nor values may "
            f"contain a NUL character, but there is {shown(name)} = {shown(value)}; correct it"
        )


def _check_folder(folder: object) -> None:
    """Check that a folder is inside the archive."""
    check_text(folder, "model.working_folder", ModelError)
    path = PurePosixPath(str(folder).replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in str(folder) or "\0" in str(folder):
        raise ModelError(
            'model.working_folder: must be a folder in the FMU, such as "resources", but is '
            f"{shown(folder)}; leave it out to use the folder in which the program was started"
        )


def check_solver(interface: Interface, name: SolverName) -> None:
    """Check that a solver supports an interface.

    Raises
    ------
    ModelError
        If it does not. The message names the solvers that do.
    """
    exchange = interface == "model_exchange"
    if exchange is (name == "fmu"):
        usable = "dormand_prince, rk4 or cvode" if exchange else "fmu"
        raise ModelError(
            f"model.solver: must be {usable} for {interface}, but is {name}; change one of the two"
        )
