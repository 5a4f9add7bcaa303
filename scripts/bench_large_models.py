"""The closed loop on models of 2 to 200 states that lack one effect: seconds and memory.

    python scripts/bench_large_models.py [--only rod ladder] [--screening]

A mass on a spring (2 states), a rod that conducts heat (12), an electric ladder network (50) and a
building of 100 rooms (200); each with five training experiments of 1,000 samples and one held out.
The data come from SciPy's integrators and the equations here, with noise. Each model has a process
of its own. Printed are what the screening of the declared model's residual took, the peak of the
memory up to then, and what the loop found beside what is missing.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from build_fmus import build
from scipy.integrate import solve_ivp

import cluster_est as ce
from cluster_est.closed_loop.prepare import LoopRequest, open_workbench
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.workbench import FitStart
from workers.messages import FloatArray, Role

SAMPLES, NOISE = 1000, 0.01
ROLES: tuple[Role, ...] = (*("train",) * 5, "test")
HELD = 25
"""Samples for which an input is held."""

Rates = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class LargeModel:
    """A model as equations in C and in NumPy, and what the one in C lacks.

    Attributes
    ----------
    step
        Between samples.
    parameters
        True values by name.
    inputs
        The range of each.
    states, outputs
        Names; an output "y_X" shows the state X.
    equations
        In C, of the model that lacks the effect.
    rates
        Of the states with the effect: f(x, u).
    site, forms
        Where it acts, and the names that are right.
    """

    name: str
    step: float
    parameters: dict[str, float]
    inputs: dict[str, tuple[float, float]]
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    equations: tuple[str, ...]
    rates: Rates
    site: str
    forms: tuple[str, ...]

    @property
    def times(self) -> FloatArray:
        return np.asarray(np.arange(SAMPLES) * self.step, float)


def spring() -> LargeModel:
    """A mass on a spring that lacks a drag."""

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        return np.array([x[1], u[0] - 4.0 * x[0] - 0.4 * x[1] - 0.3 * x[1] * abs(x[1])])

    equations = ("der_x = M(v)", "der_v = M(F) - M(k) * M(x) - M(c) * M(v)")
    given = {"k": 4.0, "c": 0.4}
    return LargeModel("spring", 0.05, given, {"F": (-4.0, 4.0)}, ("x", "v"), ("x",), equations,
                      rates, "der(v)", ("quadratic",))  # fmt: skip


def rod() -> LargeModel:
    """Twelve nodes above the temperature of their surroundings; the eighth lacks a leak."""
    count, leaking = 12, 8
    neighbours = np.eye(count, k=1) + np.eye(count, k=-1)
    matrix = 0.3 * (neighbours - np.diag(neighbours.sum(axis=1))) - 0.005 * np.eye(count)
    matrix[leaking - 1, leaking - 1] -= 0.05

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        found = matrix @ x
        found[0] += u[0]
        return np.asarray(found)

    equations = []
    for i in range(1, count + 1):
        beside = [f"M(T{j}) - M(T{i})" for j in (i - 1, i + 1) if 1 <= j <= count]
        heated = " + M(heating)" if i == 1 else ""
        flow = " + ".join(beside)
        equations.append(f"der_T{i} = M(conduction) * ({flow}) - M(loss) * M(T{i}){heated}")
    states = tuple(f"T{i}" for i in range(1, count + 1))
    given = {"conduction": 0.3, "loss": 0.005}
    return LargeModel("rod", 0.8, given, {"heating": (0.0, 3.0)}, states,
                      ("T2", "T5", "T8", "T11"), tuple(equations), rates, "der(T8)",
                      ("viscous", "linear"))  # fmt: skip


def ladder() -> LargeModel:
    """Sections of a coil and a capacitor each; the 13th capacitor lacks a leak that is cubic."""
    count, leaking = 25, 13

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        i, v = x[:count], x[count:]
        before = np.concatenate([u, v[:-1]])
        after = np.append(i[1:], v[-1] / 1.2)
        found = np.concatenate([(before - v - 0.05 * i) / 0.8, (i - after) / 0.8])
        found[count + leaking - 1] -= 0.15 * v[leaking - 1] ** 3
        return found

    coils, capacitors = [], []
    for j in range(1, count + 1):
        before = "source" if j == 1 else f"u{j - 1}"
        after = f"M(i{j + 1})" if j < count else f"M(u{j}) / M(load)"
        coils.append(f"der_i{j} = (M({before}) - M(u{j}) - M(R) * M(i{j})) / M(L)")
        capacitors.append(f"der_u{j} = (M(i{j}) - {after}) / M(C)")
    states = tuple(f"{kind}{j}" for kind in "iu" for j in range(1, count + 1))
    given = {"R": 0.05, "L": 0.8, "C": 0.8, "load": 1.2}
    return LargeModel("ladder", 0.1, given, {"source": (-2.0, 2.0)}, states,
                      ("u5", "u13", "u20", "u25"), (*coils, *capacitors), rates,
                      f"der(u{leaking})", ("cubic",))  # fmt: skip


def building() -> LargeModel:
    """A hundred rooms, each with its walls, in four heated zones; one lacks a loss."""
    side, lossy = 10, 44
    rooms = range(side * side)
    beside = [
        [r for r, ok in ((n - 1, n % side), (n + 1, (n + 1) % side), (n - side, n >= side),
                         (n + side, n < side * (side - 1))) if ok]
        for n in rooms
    ]  # fmt: skip
    zone = [2 * (n // side >= side // 2) + (n % side >= side // 2) for n in rooms]
    outside = np.array([4 - len(own) for own in beside], float)
    joined = np.zeros((len(rooms), len(rooms)))
    for n, own in enumerate(beside):
        joined[n, own] = 1.0
        joined[n, n] = -len(own)
    heated = np.array(zone)

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        air, wall = x[: len(rooms)], x[len(rooms) :]
        found = 0.25 * (joined @ air) + 0.5 * (wall - air) + 0.1 * outside * (u[0] - air)
        found += u[1 + heated]
        found[lossy] -= 0.02 * air[lossy] * abs(air[lossy])
        walls = 0.1 * (air - wall) + 0.02 * (u[0] - wall)
        return np.concatenate([found, walls])

    airs, walls = [], []
    for n, own in enumerate(beside):
        flow = " + ".join(f"M(T{r}) - M(T{n})" for r in own)
        airs.append(
            f"der_T{n} = M(between) * ({flow}) + M(inner) * (M(W{n}) - M(T{n})) + "
            f"{outside[n]:.1f} * M(window) * (M(Tout) - M(T{n})) + M(zone{zone[n]})"
        )
        walls.append(f"der_W{n} = M(store) * (M(T{n}) - M(W{n})) + M(outer) * (M(Tout) - M(W{n}))")
    states = tuple(f"{kind}{n}" for kind in "TW" for n in rooms)
    given = {"between": 0.25, "inner": 0.5, "window": 0.1, "store": 0.1, "outer": 0.02}
    inputs = {"Tout": (-8.0, 8.0), **{f"zone{z}": (0.0, 2.0) for z in range(4)}}
    shown = tuple(f"T{n}" for n in range(0, side * side, 11))
    return LargeModel("building", 0.1, given, inputs, states, shown, (*airs, *walls), rates,
                      f"der(T{lossy})", ("quadratic", "square"))  # fmt: skip


MODELS = {"spring": spring, "rod": rod, "ladder": ladder, "building": building}


def build_archive(model: LargeModel, folder: Path) -> bytes:
    """Write the model's sources and build them."""
    own = folder / model.name
    own.mkdir()
    entries = [f'description = "{model.name}"', "max_step = 0.1", "[experiment]"]
    entries += [f"stop = {model.times[-1]}", f"step = {model.step}"]
    entries += ["[units]", '"1" = {}']

    def variable(name: str, causality: str, start: float | None, *more: str) -> None:
        entries.extend(["[[variable]]", f'name = "{name}"', f'causality = "{causality}"'])
        entries.extend(['unit = "1"', *more] + ([] if start is None else [f"start = {start}"]))

    for name, value in model.parameters.items():
        variable(name, "parameter", value, 'variability = "tunable"')
    for name in model.inputs:
        variable(name, "input", 0.0)
    for name in model.states:
        variable(name, "local", 0.0, f'derivative = {{ name = "der({name})", unit = "1" }}')
    for name in model.outputs:
        variable(f"y_{name}", "output", None)
    lines = [left_and_right(each) for each in model.equations]
    lines += [f"    M(y_{name}) = M({name});" for name in model.outputs]
    text = '#include "fmi2_model.h"\n\nfmi2Status model_equations(Model *m)\n{\n'
    (own / "model.c").write_text(text + "\n".join(lines) + "\n    return fmi2OK;\n}\n", "utf-8")
    (own / "model.toml").write_text("\n".join(entries) + "\n", "utf-8")
    return build(own, folder).read_bytes()


def left_and_right(equation: str) -> str:
    """An equation as a statement in C."""
    left, _, right = equation.partition(" = ")
    return f"    M({left}) = {right};"


def simulate(model: LargeModel, number: int) -> tuple[tuple[ce.Input, ...], FloatArray]:
    """The inputs of an experiment, held for a while, and the true outputs, (samples, outputs)."""
    random = np.random.default_rng([17, number])
    times = model.times
    given = {
        name: np.repeat(random.uniform(*ends, SAMPLES // HELD), HELD)
        for name, ends in model.inputs.items()
    }
    held = np.array(list(given.values()))
    states = np.zeros((SAMPLES, len(model.states)))
    for first in range(0, SAMPLES, HELD):
        last = min(first + HELD, SAMPLES - 1)
        u = held[:, first]
        found = solve_ivp(
            lambda _, x, u=u: model.rates(x, u),
            (times[first], times[last]),
            states[first],
            t_eval=times[first : last + 1],
            rtol=1e-8,
            atol=1e-9,
        )
        states[first : last + 1] = found.y.T
    inputs = tuple(ce.Input(name, times, values, "hold") for name, values in given.items())
    return inputs, states[:, [model.states.index(name) for name in model.outputs]]


def make_problem(model: LargeModel, archive: bytes) -> ce.Problem:
    """The declared model with noisy data, its parameters some way off."""
    solver = ce.Solver("dormand_prince", rtol=1e-6, atol=1e-8)
    fmu = ce.Model(model.name, archive, "model_exchange", solver, tuple(model.parameters))
    parameters = tuple(
        ce.Parameter(name, 1.15 * value, 0.1 * value, 10.0 * value)
        for name, value in model.parameters.items()
    )
    runs = [simulate(model, number) for number in range(len(ROLES))]
    sigmas = NOISE * np.std([curves for _, curves in runs], axis=(0, 1))
    experiments = []
    for number, ((inputs, curves), role) in enumerate(zip(runs, ROLES, strict=True)):
        noise = np.random.default_rng([18, number]).standard_normal(curves.shape)
        noisy = (curves + sigmas * noise).T
        outputs = tuple(
            ce.Output(f"y_{name}", model.times, values, float(sigma))
            for name, values, sigma in zip(model.outputs, noisy, sigmas, strict=True)
        )
        stop = float(model.times[-1])
        experiments.append(ce.Experiment(f"e{number}", 0.0, stop, inputs, outputs, role=role))
    return ce.Problem(fmu, parameters, tuple(experiments))


def try_model(name: str, *, loop: bool) -> None:
    """Screen one model, and close the loop on it."""
    model = MODELS[name]()
    with tempfile.TemporaryDirectory() as folder:
        problem = make_problem(model, build_archive(model, Path(folder)))
    with open_workbench(LoopRequest(problem)) as bench:
        fitted = fit_declared(bench, FitStart(bench.problem, {}))
        begin = time.perf_counter()
        screening = screen(bench, fitted, 1)
        seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    best = screening.ranking.leaders(screening.ranking.plain, 1)[0]
    first = screening.ranking.trials[best].candidate
    print(
        f"{name}: {len(model.states)} states, {screening.count} candidates, screening "
        f"{seconds:.1f} s, peak {peak:.0f} MB, first {first.form.name} at {first.site}",
        flush=True,
    )
    if not loop:
        return
    begin = time.perf_counter()
    found = ce.close_loop(problem)
    seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    named = [(effect.site, effect.form) for effect in found.effects]
    right = len(named) == 1 and named[0][0] == model.site and named[0][1] in model.forms
    print(
        f"{name}: {found.verdict}, {'right' if right else 'WRONG'} "
        f"({', '.join(f'{form} at {site}' for site, form in named) or 'nothing'}; missing "
        f"{model.forms[0]} at {model.site}), held out {found.rms('test', 'before'):.2f} -> "
        f"{found.rms('test', 'after'):.2f} sigma, {found.simulations:.0f} simulations, "
        f"{seconds:.0f} s, peak {peak:.0f} MB",
        flush=True,
    )


def main() -> int:
    """Try each model in a process of its own; 1 if one could not be tried."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--screening", action="store_true", help="without the loops")
    parser.add_argument("--here", action="store_true", help="in this process")
    options = parser.parse_args()
    if options.here:
        for name in options.only:
            try_model(name, loop=not options.screening)
        return 0
    failed = 0
    for name in options.only:
        command = [sys.executable, __file__, "--here", "--only", name]
        command += ["--screening"] if options.screening else []
        failed |= subprocess.run(command).returncode
    return int(failed != 0)


if __name__ == "__main__":
    sys.exit(main())
