"""A model from the file of an FMU."""

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
    """Read an FMU, with the defaults of a config.

    Parameters
    ----------
    path
        Of the FMU.
    interface
        "auto" prefers model exchange.
    solver
        A solver or its name; "auto" is "dormand_prince" for model exchange, else "fmu".
    structure
        Structural parameters (FMI 3) that differ from their start values.
    reset
        The state that every simulation begins with; see `Model.reset`.
    environment, working_folder
        What the FMU finds around it in its process; see `Model`.
    stop_time
        Whether the FMU is told when a simulation will end; see `Model`.

    Raises
    ------
    ModelError
        If it cannot be read, or does not offer what is wanted.
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
    """Return the interface that is wanted; "auto" prefers model exchange.

    That the FMU offers it is checked when a problem is described.
    """
    check_choice(wanted, ("auto", *get_args(Interface)), "model.interface", ModelError)
    if wanted == "auto":
        return "model_exchange" if "model_exchange" in offered else offered[-1]
    return wanted  # type: ignore[return-value]
