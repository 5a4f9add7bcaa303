"""The pictures of two pages on fits: a double pendulum in segments, and a spring in a wind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benches.process_noise import made_problem as windy
from benches.shooting import SYSTEMS, made_problem
from docs.svg import Axes, document, text

import cluster_est as ce
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.shooting.first_states import first_states
from cluster_est.shooting.record_segments import Shooting, cut
from workers.messages import FloatArray

SEGMENTS, STOP, THINNED = 20, 10.0, 2
Curve = tuple[FloatArray, FloatArray]

STYLE = """
.measured { stroke: var(--edge); stroke-width: 5; fill: none; opacity: 0.55; }
"""
CUT_STYLE = STYLE + ".cut { stroke: var(--rule); stroke-dasharray: 2 4; fill: none; }\n"


def shooting_picture() -> str:
    """Three panels below each other, as SVG."""
    problem = half_off()
    output = problem.experiments[0].outputs[0]
    measured = output.times[::THINNED], output.values[::THINNED]
    fitted = ce.fit(problem, shooting={"segments": SEGMENTS})
    path = fitted.simulations[0].outcome.trajectory
    assert path is not None
    (whole,) = ce.simulate(problem).values()
    begun = whole.outcome.trajectory
    assert begun is not None
    panels = [
        ("One simulation at the start, parameters 50 % off", [curve(begun)]),
        (
            f"{SEGMENTS} segments at the same parameters, each from the measured angle",
            guess(problem),
        ),
        ("The segments at the end of the fit: one trajectory, the right parameters", [curve(path)]),
    ]
    parts: list[str] = []
    for number, (words, curves) in enumerate(panels):
        parts += panel(40 + 172 * number, words, measured, curves, cuts=number > 0)
    parts += [
        text(450, 548, "time in s; angle of the upper rod in rad", anchor="middle"),
    ]
    return document((860, 560), "Multiple shooting of a double pendulum", CUT_STYLE, parts)


def half_off() -> ce.Problem:
    """The case of the benchmark in which masses and lengths begin furthest off."""
    problem = made_problem(SYSTEMS["double_pendulum"], 2)
    (experiment,) = problem.experiments
    return replace(problem, experiments=(replace(experiment, id="swing"),))


def curve(path: object) -> Curve:
    """The measured angle along a trajectory."""
    times, values = path.times, path.values  # type: ignore[attr-defined]
    angle = values[:, path.variables.index("y1")]  # type: ignore[attr-defined]
    return times[::THINNED], angle[::THINNED]


def guess(problem: ce.Problem) -> list[Curve]:
    """The segments that the search begins with."""
    segmented = cut(problem, Shooting(segments=SEGMENTS))
    train = make_space(problem, problem.indices("train"))
    environment = RunEnvironment()
    with environment.executor(segmented.problem) as executor:
        runner = environment.runner(executor)
        first = first_states(runner, segmented, train)
        columns = [segmented.problem.parameters.index(p) for p in segmented.states.parameters]
        values = np.tile(
            [p.start for p in segmented.problem.parameters], (len(segmented.segments), 1)
        )
        values[:, columns] = first.starts
        everything = tuple(range(len(segmented.segments)))
        outcomes = runner.simulate(values, everything, "trajectory", "picture")
    return [curve(each.trajectory) for each in outcomes if each.trajectory is not None]


def panel(top: float, words: str, measured: Curve, curves: list[Curve], *, cuts: bool) -> list[str]:
    """One of the three, with what was measured behind it."""
    span = float(np.ptp(measured[1]))
    low, high = float(measured[1].min()) - 0.3 * span, float(measured[1].max()) + 0.3 * span
    axes = Axes(60, 836, top, top + 118, (0.0, STOP), (low, high))
    ticks = [each for each in (-8.0, -4.0, 0.0, 4.0, 8.0) if low < each < high]
    parts = [text(60, top - 10, words, "head"), *axes.rules(ticks), *axes.numbers(range(0, 11, 2))]
    if cuts:
        edges = np.linspace(0.0, STOP, SEGMENTS + 1)
        places = (f"{axes.across(each):.1f}" for each in edges.tolist())
        parts += [f'<path class="cut" d="M{x} {top}V{top + 118}"/>' for x in places]
    parts.append(axes.curve(*measured, "measured"))
    for times, values in curves:
        parts.append(axes.curve(times, np.clip(values, low, high), "line c1"))
    return parts


def noise_picture() -> str:
    """A record with both fits, and what each leaves, as SVG."""
    parts: list[str] = []
    for number, (words, noise) in enumerate(
        (
            ("Fitted by output errors: one simulation from the start to the end", False),
            ("Fitted by prediction errors: from each measured time to the next", True),
        )
    ):
        times, measured, followed = fitted(noise=noise)
        parts += noise_panel(40 + 225 * number, words, (times, measured, followed))
    parts.append(text(450, 460, "time in s; position and residual in m", anchor="middle"))
    title = "A spring in an unknown wind, by output errors and by prediction errors"
    return document((860, 470), title, STYLE, parts)


def fitted(*, noise: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, what was measured, and what a fit makes of it."""
    result = ce.fit(windy(4, noise=noise))
    output = result.problem.experiments[0].outputs[0]
    path = result.simulations[0].outcome.trajectory
    assert path is not None
    return output.times, output.values, path.at("y", output.times)


def noise_panel(
    top: float, words: str, curves: tuple[FloatArray, FloatArray, FloatArray]
) -> list[str]:
    """Measured and followed, and below it the residual on the same scale."""
    times, measured, followed = curves
    high = 1.15 * float(np.max(np.abs(np.concatenate([measured, followed]))))
    above = Axes(60, 836, top, top + 104, (0.0, 7.98), (-high, high))
    below = Axes(60, 836, top + 110, top + 160, (0.0, 7.98), (-0.5 * high, 0.5 * high))
    return [
        text(60, top - 10, words, "head"),
        *above.rules([-0.2, 0.0, 0.2]),
        above.curve(times, measured, "measured"),
        above.curve(times, followed, "line c1"),
        *below.rules([0.0]),
        below.curve(times, measured - followed, "line c0"),
        *below.numbers(range(9)[:8]),
    ]
