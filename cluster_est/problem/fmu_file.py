"""Reads a model from an FMU file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

from cluster_est.errors import ModelError
from workers.fmu.description import describe
from workers.messages import Interface, Model, ResetPolicy, Solver, SolverName
from workers.messages.checks import as_pairs, as_path, check_choice, check_number


def read_model(
    path: str | Path,
    *,
    interface: Interface | Literal["auto"] = "auto",
    solver: Solver | SolverName | Literal["auto"] = "auto",
    structure: Mapping[str, int] | None = None,
    reset: ResetPolicy = "auto",
    environment: Mapping[str, str] | None = None,
    working_folder: str = "",
    stop_time: bool | None = None,
) -> Model:
    """Read a model from an FMU file, with the default settings of a config.

    Parameters
    ----------
    path
        Path of the FMU.
    interface
        Interface of the FMU; "auto" prefers model exchange.
    solver
        A solver or its name; "auto" is "dormand_prince" for model exchange, else "fmu".
    structure
        Structural parameters (FMI 3) that differ from their start values.
    reset
        Initial state of every simulation; see `Model.reset`.
    environment, working_folder
        Environment variables and working folder of the FMU's process; see `Model`.
    stop_time
        Whether the FMU is told when a simulation will end; see `Model`.

    Raises
    ------
    ModelError
        If the FMU cannot be read, or the interface or the solver is invalid.
    """
    path = as_path(path, "model.fmu", ModelError)
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"model.fmu: {path} cannot be read ({error.strerror}); check the path"
        ) from error
    chosen = dict(as_pairs({} if structure is None else structure, "model.structure", ModelError))
    for name, value in chosen.items():
        check_number(value, f"model.structure.{name}", ModelError, whole=True)
    description = describe(path.name, archive, chosen)
    found = choose_interface(interface, description.interfaces)
    if solver == "auto":
        solver = "dormand_prince" if found == "model_exchange" else "fmu"
    if isinstance(solver, str):
        check_choice(solver, get_args(SolverName), "model.solver", ModelError)
        solver = Solver(solver)
    return Model(
        path.name,
        archive,
        found,
        solver,
        parameters=(),
        structure=tuple(chosen.items()),
        reset=reset,
        environment=as_pairs(environment or {}, "model.environment", ModelError),
        working_folder=working_folder,
        stop_time=stop_time,
    )


def choose_interface(wanted: str, offered: tuple[Interface, ...]) -> Interface:
    """Return the wanted interface; "auto" prefers model exchange.

    `Problem.describe` checks whether the FMU offers it.
    """
    check_choice(wanted, ("auto", *get_args(Interface)), "model.interface", ModelError)
    if wanted == "auto":
        return "model_exchange" if "model_exchange" in offered else offered[-1]
    return wanted  # type: ignore[return-value]
