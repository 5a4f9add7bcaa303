"""Why a process is not waited for any longer, or what became of it: sentences for outcomes."""

from __future__ import annotations

import signal
from dataclasses import dataclass

from workers.messages import Limits, Status
from workers.probes.memory import resident_bytes
from workers.process.watch import ProgressWatch

LOAD_SECONDS = 300.0
"""For which a process may stand still outside of a simulation: it loads the FMU, compiles what
simulates, or compares the outputs with what was measured."""


@dataclass(frozen=True)
class ProcessFailure:
    """Why a process did not answer."""

    status: Status
    message: str

    @property
    def from_outside(self) -> bool:
        """True if somebody else ended it, so that the simulation is not to blame."""
        return self.status is Status.LOST_WORKER


def too_late(watch: ProgressWatch, limits: Limits) -> ProcessFailure | None:
    """Why a simulation is not waited for any longer; None if it is."""
    if watch.simulated > limits.seconds:
        return ProcessFailure(
            Status.TIMEOUT,
            f"the simulation did not end within {limits.seconds:.3g} s and was stopped; raise "
            "executor.timeout if it only needs longer",
        )
    if not watch.simulates:
        return _too_late_outside(watch, max(limits.stall, LOAD_SECONDS))
    most = limits.stall
    if watch.still > most:
        return ProcessFailure(
            Status.TIMEOUT,
            f"the simulation stood still for {most:.3g} s, in which no step ended, and was "
            "stopped; check that the FMU does not wait for a licence or a window, or raise "
            "executor.stall if one step of it takes so long",
        )
    return None


def _too_late_outside(watch: ProgressWatch, most: float) -> ProcessFailure | None:
    """Return the failure of a process that stands still before or after a simulation."""
    if watch.still <= most:
        return None
    return ProcessFailure(
        Status.TIMEOUT,
        f"what comes before or after the simulation, such as loading, compiling or a function of "
        f"the config's, took {most:.3g} s without an end and was stopped; check that function, or "
        "raise executor.stall",
    )


def too_large(child: int, limits: Limits) -> ProcessFailure | None:
    """Return the failure of a process that has more memory than it may; None if it has not."""
    resident = resident_bytes(child)
    if resident <= limits.memory:
        return None
    return ProcessFailure(
        Status.OUT_OF_MEMORY,
        f"the simulation took {resident / 2**20:.0f} MB of memory and was stopped; "
        "raise executor.memory if it needs that much",
    )


def how_it_ended(code: int | None) -> ProcessFailure:
    """Return the failure of a process that ended in the middle of a simulation."""
    if code is None or code == -signal.SIGKILL:
        message = "the process was killed from outside, perhaps because memory ran out"
        return ProcessFailure(Status.LOST_WORKER, message)
    if code < 0:
        name = _signal_name(-code)
        return ProcessFailure(Status.CRASH, f"the process crashed during this simulation ({name})")
    message = f"the process was ended by the FMU during this simulation (exit code {code})"
    return ProcessFailure(Status.CRASH, message)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
