"""The core of another processor or system, in a process of an emulator: used as the one here.

A call of the core is carried over there with all memory that it reads, and what it wrote is carried
back. The FMU is instantiated there too, from a library of the same sources. Only what simulations
without CVODE need is there.

python tests/support/foreign_core.py PLATFORM FOLDER EMULATOR...

builds all of it in the folder and prints the hashes of `simulation_hashes`.
"""

from __future__ import annotations

import ctypes
import struct
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import build_fmus
from fmus.header import header
from fmus.variables import MODELS as OWN_MODELS
from fmus.variables import read_model
from support import simulation_hashes

from workers.core import build, library
from workers.core.library import (
    FUNCTIONS,
    TYPES,
    Batch,
    Effects,
    Experiment,
    Pieces,
    Record,
    Settings,
)
from workers.fmu.description import ModelDescription
from workers.messages import Model

HOST = Path(__file__).with_name("foreign_host.c")
FMI2 = {
    "reset": "Reset", "setup_experiment": "SetupExperiment",
    "enter_initialization_mode": "EnterInitializationMode",
    "exit_initialization_mode": "ExitInitializationMode", "set_string": "SetString",
    "set_time": "SetTime", "set_continuous_states": "SetContinuousStates",
    "get_continuous_states": "GetContinuousStates", "get_nominals": "GetNominalsOfContinuousStates",
    "get_derivatives": "GetDerivatives", "get_event_indicators": "GetEventIndicators",
    "enter_event_mode": "EnterEventMode", "update_discrete_states": "NewDiscreteStates",
    "enter_continuous_time_mode": "EnterContinuousTimeMode",
    "completed_integrator_step": "CompletedIntegratorStep", "do_step": "DoStep",
    "set_real_input_derivatives": "SetRealInputDerivatives",
    "get_directional_derivative": "GetDirectionalDerivative",
}  # fmt: skip
TYPES_IN_2 = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean"}
OFFSET_OF_COUNTS = 8
"""Of the counts in byte code, behind its mark."""
ELEMENT_SIZE = 40


class Host:
    """The process over there."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self._process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def ask(self, operation: str, *arguments: int, payload: bytes = b"") -> tuple[int, bytes]:
        """Send a request; returns the number of its answer, and the bytes behind it."""
        assert self._process.stdin is not None
        padded = [*arguments, *[0] * (8 - len(arguments))]
        request = struct.pack("<10Q", ord(operation), len(payload), *padded)
        self._process.stdin.write(request + payload)
        self._process.stdin.flush()
        answer, size = struct.unpack("<2Q", self._read(16))
        return answer, self._read(size)

    def load(self, file: str) -> int:
        found, _ = self.ask("L", payload=f"./{file}".encode())
        assert found, f"{file} cannot be loaded"
        return found

    def find(self, of: int, name: str) -> int:
        return self.ask("F", of, payload=name.encode())[0]

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait() == 0

    @property
    def is_open(self) -> bool:
        return self._process.poll() is None

    def _read(self, size: int) -> bytes:
        assert self._process.stdout is not None
        found = self._process.stdout.read(size) if size else b""
        assert len(found) == size, f"it has ended with exit code {self._process.wait()}"
        return found


class Mirror:
    """Memory of one call: carried over when it is asked for, and what is written carried back."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._there: list[int] = []
        self._written: list[tuple[int, int, int]] = []

    def __enter__(self) -> Mirror:
        return self

    def __exit__(self, *_: object) -> None:
        for here, there, size in self._written:
            ctypes.memmove(here, self._host.ask("G", there, size)[1], size)
        for there in self._there:
            self._host.ask("D", there)

    def bytes(self, content: bytes) -> int:
        there, _ = self._host.ask("P", payload=content)
        self._there.append(there)
        return there

    def read(self, here: int | None, size: int) -> int:
        """What is at an address here, for reading alone; nothing where there is nothing."""
        return self.bytes(ctypes.string_at(here, size)) if here else 0

    def write(self, here: int | None, size: int) -> int:
        there = self.read(here, size)
        if here:
            self._written.append((here, there, size))
        return there

    def fields(self, structure: ctypes.Structure, **sizes: int) -> None:
        """Let fields that are addresses of so many bytes to read be such over there."""
        for name, size in sizes.items():
            setattr(structure, name, self.read(getattr(structure, name), size))

    def structure(self, structure: ctypes.Structure) -> int:
        return self.bytes(bytes(structure))


class ForeignCore:
    """Functions of the core, as `workers.core.library` has them."""

    def __init__(self, host: Host, file: str) -> None:
        self._host = host
        self._library = host.load(file)
        self._programs: dict[int, tuple[int, ...]] = {}
        self._fmu: dict[str, int] = {}
        self._handle = 0

    def use_fmu(self, file: str, description: ModelDescription, exchange: bool) -> None:
        """Simulate an instance of this FMU from now on."""
        binary = self._host.load(file)
        find = partial(self._host.find, binary)
        self._fmu = {name: find(f"fmi2{whole}") for name, whole in FMI2.items()}
        for kind in "Get", "Set":
            self._fmu |= {f"{kind}{t}": find(f"fmi2{kind}{TYPES_IN_2[t]}") for t in TYPES_IN_2}
        names = b"".join(text.encode() + b"\0" for text in ("instance", description.guid))
        at = find("fmi2Instantiate")
        self._handle, _ = self._host.ask("I", at, int(not exchange), payload=names)
        assert self._handle

    def core_program(self, code: bytes, size: int, _wrong: Any) -> int:
        with Mirror(self._host) as m:
            made = self._call("core_program", m.bytes(code), size, m.bytes(bytes(8)))
        self._programs[made] = struct.unpack_from("<16I", code, OFFSET_OF_COUNTS)
        return made

    def core_program_free(self, program: int) -> None:
        if self._host.is_open:  # programs that are kept for later outlive it
            self._call("core_program_free", program)

    def core_simulate(self, address: int) -> int:
        b = Batch.from_buffer_copy(Batch.from_address(address))
        with Mirror(self._host) as m:
            e = Experiment.from_buffer_copy(Experiment.from_address(b.experiment))
            s = Settings.from_buffer_copy(Settings.from_address(b.settings))
            t, p = e.n_times, b.n_points
            assert (b.bounds, b.cvode, b.states_out, e.n_strings) == (None, None, None, 0)
            m.fields(s, atols=8 * b.n_states)
            outputs, effects = 8 * p * t * e.n_outputs, self._effects(m, b.effects, p)
            for each in (e.structure, e.numbers, e.inputs, e.continuous_inputs, e.outputs):
                m.fields(each, reals=4 * each.n_reals, elements=ELEMENT_SIZE * each.n_elements)
            row = 8 * t * e.n_inputs
            e.gather = e.by_time = e.row_ends = e.measured = e.sigmas = None  # of bounds
            m.fields(e, times=8 * t, intervals=8 * t, values=row, slopes=row, jumps=t, passed=t)
            b.fmu, b.effects = self._component(m, b.fmu), effects
            b.experiment, b.settings = m.structure(e), m.structure(s)
            b.points = m.read(b.points, 8 * p * b.n_values)
            b.progress, b.outputs = m.write(b.progress, 32), m.write(b.outputs, outputs)
            for name in ("codes", "indices", "steps", "stopped_at"):
                setattr(b, name, m.write(getattr(b, name), 8 * p))
            return self._call("core_simulate", m.structure(b))

    def core_apply_to_outputs(self, address: int) -> int:
        r = Record.from_buffer_copy(Record.from_address(address))
        with Mirror(self._host) as m:
            row = 8 * r.n_times * r.n_inputs
            counts = self._programs[r.program]
            m.fields(
                r, times=8 * r.n_times, values=row, slopes=row, coefficients=8 * counts[4],
                linear=8 * counts[2] ** 2,
            )  # fmt: skip
            r.outputs = m.write(r.outputs, 8 * r.n_times * r.n_outputs)
            return self._call("core_apply_to_outputs", m.structure(r)) & 0xFFFFFFFF

    def core_refine(self, address: int) -> None:
        r = Pieces.from_buffer_copy(Pieces.from_address(address))
        with Mirror(self._host) as m:
            t, u, y = 8 * r.n_times, 8 * r.n_inputs, 8 * r.n_outputs
            m.fields(
                r, times=t, lengths=t, values=t * r.n_inputs, slopes=t * r.n_inputs,
                outputs=t * r.n_outputs, first=t - 8, smooth=r.n_times - 1,
            )  # fmt: skip
            rows = (r.n_times - 1) * r.pieces + 1
            r.at, r.fine_outputs = m.write(r.at, 8 * rows), m.write(r.fine_outputs, y * rows)
            r.fine_values = m.write(r.fine_values, u * rows)
            r.fine_slopes = m.write(r.fine_slopes, u * rows)
            self._call("core_refine", m.structure(r))

    def core_delay(self, *arguments: Any) -> int:
        return self._of_signal("core_delay", *arguments)

    def core_backlash(self, *arguments: Any) -> int:
        return self._of_signal("core_backlash", *arguments)

    def core_rate_limit(
        self, times: int, values: int, n: int, held: int, start: float, fastest: float, *to: int
    ) -> int:
        with Mirror(self._host) as m:
            signal = m.read(times, 8 * n), m.read(values, 8 * n)
            room = [m.write(each, 8 * (2 * n + 1)) for each in to]
            packed = struct.pack("<4Q2d2Q", *signal, n, held, start, fastest, *room)
            return self._host.ask("R", self._at("core_rate_limit"), payload=packed)[0]

    def _of_signal(self, name: str, times: int, values: int, n: int, how: float, *to: int) -> int:
        with Mirror(self._host) as m:
            signal = m.read(times, 8 * n), m.read(values, 8 * n)
            room = [m.write(each, 8 * (2 * n + 1)) for each in to]
            (bits,) = struct.unpack("<Q", struct.pack("<d", how))
            return self._host.ask("S", self._at(name), *signal, n, bits, *room)[0]

    def _effects(self, m: Mirror, address: int, n_points: int) -> int:
        effects = Effects.from_buffer_copy(Effects.from_address(address))
        if effects.program:
            counts = self._programs[effects.program]
            m.fields(
                effects, parameters=4 * counts[7], fastest_rates=8 * n_points,
                coefficients=8 * n_points * counts[4], base=8 * n_points * counts[5],
            )  # fmt: skip
        return m.structure(effects)

    def _component(self, m: Mirror, address: int) -> int:
        """The instance over there, with those functions that are used here."""
        fmu = library.Fmu.from_buffer_copy(library.Fmu.from_address(address))
        for name in FUNCTIONS:
            if getattr(fmu, name):
                setattr(fmu, name, self._fmu[name])
        for i, kind in enumerate(TYPES):
            fmu.get[i], fmu.set[i] = (self._fmu.get(f"{way}{kind}", 0) for way in ("Get", "Set"))
        fmu.handle = self._handle
        return m.structure(fmu)

    def _at(self, name: str) -> int:
        return self._host.find(self._library, name)

    def _call(self, name: str, *arguments: int) -> int:
        return self._host.ask("C", self._at(name), *arguments)[0]


# ---- what is built -------------------------------------------------------------------------------


def zig_for(platform: str) -> tuple[str, ...]:
    command = build.zig()
    assert command is not None
    return (*command, "-target", build.PLATFORMS[platform], "-fno-sanitize=undefined")


def build_host(platform: str, folder: Path) -> str:
    name = "host.exe" if "windows" in platform else "host"
    command = [*zig_for(platform), "-std=gnu11", "-O1", str(HOST), "-o", str(folder / name)]
    subprocess.run([*command, *(() if "windows" in platform else ("-ldl",))], check=True)
    return name


def sources_of(name: str) -> dict[str, bytes]:
    """Return the sources of a model, of the examples or of the test models, for FMI 2.0."""
    if (OWN_MODELS / name).is_dir():
        own = read_model(name, 2)
        generated = {"version.h": b"#define FMI 2\n", "model_variables.h": header(own).encode()}
        return {**own.sources, **generated}
    example = build_fmus.read_model(build_fmus.MODELS / name)
    return {**example.sources, "model_variables.h": build_fmus.c_header(example).encode()}


def build_model(platform: str, folder: Path, name: str) -> str:
    """Build the binary of a model."""
    file = name + build.suffix(platform)
    sources = folder / name
    sources.mkdir()
    for source, text in sources_of(name).items():
        (sources / source).write_bytes(text)
    files = sorted(map(str, sources.glob("*.c")))
    flags = ["-std=gnu11", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared"]
    command = [*zig_for(platform), *flags, f"-I{build_fmus.FMI_HEADERS}", *files]
    subprocess.run([*command, "-o", str(folder / file), "-lm"], check=True)
    return file


def main(platform: str, folder: Path, emulator: Sequence[str]) -> None:
    file = "core" + build.suffix(platform)
    build.compile_for(platform, folder / file)
    built: dict[str, str] = {}
    host = Host([*emulator, f"./{build_host(platform, folder)}"], folder)
    foreign = ForeignCore(host, file)
    setattr(library, "load", lambda _: foreign)  # noqa: B010

    def use(model: Model, description: ModelDescription) -> None:
        name = Path(model.name).stem.removesuffix("_fmi2")
        if name not in built:
            built[name] = build_model(platform, folder, name)
        foreign.use_fmu(built[name], description, model.interface == "model_exchange")

    for line in simulation_hashes.lines(use):
        print(line, flush=True)
    host.close()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
