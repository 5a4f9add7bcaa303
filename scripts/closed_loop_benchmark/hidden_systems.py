"""Systems of the cases of hidden dynamics: equations as text, for both the FMU and the truth.

    from closed_loop_benchmark.hidden_systems import HIDDEN_SYSTEMS, archive

    oven = HIDDEN_SYSTEMS["oven"]
    fmu = archive("oven")

Their FMUs are not stored; the system's compiler builds them when needed.
"""

from __future__ import annotations

import re
import tempfile
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from build_fmus import SCAFFOLD, Model, build_archive, read_variables

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Equations, Excitation, Role, Run, System, make_run

FILE = tomllib.loads(Path(__file__).with_name("hidden_systems.toml").read_text(encoding="utf-8"))
UNITS: dict[str, dict[str, Any]] = FILE.pop("units")
PUSHES: dict[str, tuple[str, float]] = {name: tuple(given["push"]) for name, given in FILE.items()}
"""The disturbed state by system, and the size of the disturbance in units of the rate."""

WAVES: tuple[tuple[str, Role], ...] = (
    ("held steps", "train"),
    ("binary", "train"),
    ("ramps", "train"),
    ("noise", "train"),
    ("triangle", "test"),
    ("gentle steps", "test"),
)


def drive(waveform: str, time: Array, random: np.random.Generator, hold: float) -> Array:
    """Return a waveform of about unit amplitude that changes about every `hold` seconds."""
    if waveform == "binary":
        return wave.binary(time, random, 0.8 * hold)
    if waveform == "ramps":
        return wave.ramps(time, random, hold)
    if waveform == "noise":
        return wave.noise(time, random, 0.2 / hold)
    if waveform == "triangle":
        return wave.triangle(time, 5.0 * hold)
    return wave.held(time, random, hold) * (0.7 if waveform == "gentle steps" else 1.0)


def excitation(given: Mapping[str, Any]) -> Excitation:
    """Return the function that makes the runs of a system."""
    inputs, states = [*given["inputs"].values()], given["states"]

    def runs(time: Array, random: np.random.Generator) -> list[Run]:
        return [one(waveform, role, time, random) for waveform, role in WAVES]

    def one(waveform: str, role: Role, time: Array, random: np.random.Generator) -> Run:
        shapes = [waveform, "held steps", "ramps"]
        columns = [
            middle + amplitude * np.clip(drive(shape, time, random, hold), -1.0, 1.0)
            for shape, (_, middle, amplitude, hold) in zip(shapes, inputs, strict=False)
        ]
        starts = {name: random.uniform(low, high) for name, (_, low, high) in states.items()}
        return make_run(waveform, role, columns, starts)

    return runs


def equations(given: Mapping[str, Any], texts: list[str]) -> Equations:
    """Return equations as a function of states, inputs and parameters."""
    sections = ("states", "inputs", "parameters", "constants")
    names = [[*given.get(section, {})] for section in sections]
    codes = [compile(text, "equation", "eval") for text in texts]

    def evaluate(x: Any, u: Any, p: Any) -> tuple[Array | float, ...]:
        known = dict(zip(names[0], x, strict=False))
        known.update(zip(names[1], u, strict=True))
        known.update(zip(names[2] + names[3], p, strict=True))
        return tuple(eval(code, {}, known) for code in codes)

    return evaluate


def _system(name: str, given: Mapping[str, Any]) -> System:
    return System(
        name=name,
        split="tune",  # each case has its own split
        states=tuple(given["states"]),
        inputs=tuple(given["inputs"]),
        outputs=tuple(given["outputs"]),
        parameters={key: value for key, (_, value) in given["parameters"].items()},
        constants={key: value for key, (_, value) in given.get("constants", {}).items()},
        rates=equations(given, [*given["rates"].values()]),
        readings=equations(given, [text for _, text in given["outputs"].values()]),
        interval=given["interval"],
        samples=given["samples"],
        excitation=excitation(given),
        interface=given.get("interface", "model_exchange"),
    )


HIDDEN_SYSTEMS: dict[str, System] = {name: _system(name, given) for name, given in FILE.items()}


@cache
def archive(name: str) -> bytes:
    """Build the FMU of a system.

    Raises
    ------
    subprocess.CalledProcessError, FileNotFoundError
        If the system's compiler, which must be that of a 64-bit Linux, fails or is missing.
    """
    scaffold = [SCAFFOLD / "fmi2_model.c", SCAFFOLD / "fmi2_model.h"]
    sources = {file.name: file.read_bytes() for file in scaffold}
    sources["model.c"] = _c_source(FILE[name]).encode()
    spec = _description(name, FILE[name])
    model = Model(name, spec, read_variables(spec["variable"]), sources)
    with tempfile.TemporaryDirectory() as folder:
        return build_archive(model, Path(folder)).read_bytes()


def _c_source(given: Mapping[str, Any]) -> str:
    """Return the equations in C, with each variable by its macro."""
    left = {f"der_{state}": text for state, text in given["rates"].items()}
    left |= {output: text for output, (_, text) in given["outputs"].items()}
    lines = [f"    M({name}) = {_in_c(text)};" for name, text in left.items()]
    body = "\n".join(lines)
    head = '#include "fmi2_model.h"\n\nfmi2Status model_equations(Model *m)\n{\n'
    return f"{head}{body}\n    return fmi2OK;\n}}\n"


def _in_c(text: str) -> str:
    return re.sub(r"\b[A-Za-z]\w*", lambda match: f"M({match[0]})", text)


def _description(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of `model.toml` for an example."""
    units, variables = {"s": UNITS["s"]}, []
    for section in ("parameters", "constants"):
        variables += [
            {"name": key, "causality": "parameter", "variability": "tunable"}
            | {"start": value, "nominal": abs(value), "unit": unit}
            for key, (unit, value) in given.get(section, {}).items()
        ]
    variables += [
        {"name": key, "causality": "input", "start": middle, "unit": unit}
        | {"nominal": abs(middle) or amplitude}
        for key, (unit, middle, amplitude, _) in given["inputs"].items()
    ]
    for key, (unit, low, high) in given["states"].items():
        base = {k: v for k, v in UNITS[unit].items() if k != "offset"}
        rate_unit = f"{unit}/s"
        units[rate_unit] = base | {"s": base.get("s", 0) - 1}
        rate = {"name": f"der({key})", "unit": rate_unit}
        variables.append(
            {"name": key, "causality": "local", "start": 0.5 * (low + high), "unit": unit}
            | {"derivative": rate}
        )
    variables += [
        {"name": key, "causality": "output", "unit": unit}
        for key, (unit, _) in given["outputs"].items()
    ]
    units |= {v["unit"]: UNITS[v["unit"]] for v in variables}
    interval, stop = given["interval"], given["interval"] * (given["samples"] - 1)
    return {
        "description": name.replace("_", " "),
        "max_step": interval / 10.0,
        "experiment": {"stop": stop, "step": interval},
        "units": units,
        "variable": variables,
    }
