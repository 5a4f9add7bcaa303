"""The model that a worker simulates: an FMU, effects, solver and reset policy."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

from workers.messages.hashing import content_hash
from workers.messages.types import Interface, ResetPolicy, SolverName


@dataclass(frozen=True)
class Solver:
    """The solver of a simulation, and its settings.

    Attributes
    ----------
    name
        "dormand_prince", "rk4" or, for stiff models, "cvode" for model exchange; "fmu" for
        co-simulation, where the FMU brings its own.
    step
        Seconds. The step of "rk4", the longest step of "dormand_prince" and "cvode", the longest
        communication step of "fmu". None: one step from each time in the data to the next ("rk4",
        "fmu"), no limit ("dormand_prince", "cvode").
    rtol, atol
        Tolerances of the error of one step; `atol` is in units of each state's nominal value.
        For "fmu", `rtol` is handed to the FMU, None leaves the choice to it.
    max_steps
        Steps after which a simulation counts as failed.
    """

    name: SolverName
    step: float | None = None
    rtol: float | None = None
    atol: float | None = None
    max_steps: int = 1_000_000


@dataclass(frozen=True)
class Effect:
    """A term that the model lacks, around the FMU.

    Attributes
    ----------
    name
        Chosen by the user; its coefficients are called "NAME.COEFFICIENT".
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form
        Name of a form of the library; empty where `equation` says what it is.
    variables
        What the form is a function of: states, inputs and measured signals by name (at outputs
        also outputs), or the difference of two, "v - w".
    equation
        An equation of the user's own, in the FMU's names, `t`, `s` and `coefficients`.
    coefficients
        (name, neutral value) of the own equation's coefficients; the neutral value is None for a
        shape parameter.
    """

    name: str
    site: str
    form: str = ""
    variables: tuple[str, ...] = ()
    equation: str = ""
    coefficients: tuple[tuple[str, float | None], ...] = ()


@dataclass(frozen=True)
class Model:
    """The model that a worker simulates: an FMU and its solver.

    Attributes
    ----------
    name
        The file's name, for messages.
    archive
        The bytes of the FMU, so that a worker on another machine needs no file.
    interface, solver
        Which of the FMU's interfaces, and how.
    parameters
        Names of the variables that every task's `values` are for, in that order.
    structure
        (name, value) of structural parameters (FMI 3) that differ from their start values: they
        say how large arrays are, so they are the same in all experiments.
    logging_on
        Whether the FMU logs all that it can, and its messages go to stderr too as they come.
    reset
        The reset policy: every simulation begins with a "reset" of the instance that there is; a
        new "instance", for FMUs whose reset leaves something behind; or a new "process", for those
        whose library does. "auto" leaves the choice to the coordinator; a worker resets.
    """

    name: str
    archive: bytes = field(repr=False)
    interface: Interface
    solver: Solver
    parameters: tuple[str, ...]
    structure: tuple[tuple[str, int], ...] = ()
    logging_on: bool = False
    reset: ResetPolicy = "auto"

    @cached_property
    def archive_hash(self) -> str:
        """SHA-256 of the FMU, the name of its unpacked folder."""
        return hashlib.sha256(self.archive).hexdigest()

    @cached_property
    def key(self) -> str:
        """Hash of everything that makes a simulation's result, but values and experiment."""
        more = [repr(self.structure)] if self.structure else []
        more += [f"renew {self.reset}"] if self.reset != "auto" else []
        return content_hash(
            [self.archive_hash, self.interface, repr(self.solver), *self.parameters, *more]
        )
