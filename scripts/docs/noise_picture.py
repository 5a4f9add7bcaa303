"""The picture of the page on process noise: a spring in a wind, simulated and predicted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from docs.svg import Axes, document, text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benches.process_noise import made_problem

import cluster_est as ce
from workers.messages import FloatArray

WIDTH, HEIGHT = 860, 470
SEED, STOP = 4, 7.98
STYLE = """
.measured { stroke: var(--edge); stroke-width: 5; fill: none; opacity: 0.55; }
"""


def picture() -> str:
    """A record with both fits, and what each leaves, as SVG."""
    parts: list[str] = []
    for number, (words, noise) in enumerate(
        (
            ("Fitted by output errors: one simulation from the start to the end", False),
            ("Fitted by prediction errors: from each measured time to the next", True),
        )
    ):
        times, measured, followed = fitted(noise=noise)
        parts += panel(40 + 225 * number, words, (times, measured, followed))
    parts.append(text(450, HEIGHT - 10, "time in s; position and residual in m", anchor="middle"))
    title = "A spring in an unknown wind, by output errors and by prediction errors"
    return document((WIDTH, HEIGHT), title, STYLE, parts)


def fitted(*, noise: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, what was measured, and what a fit makes of it."""
    result = ce.fit(made_problem(SEED, noise=noise))
    output = result.problem.experiments[0].outputs[0]
    path = result.simulations[0].outcome.trajectory
    assert path is not None
    return output.times, output.values, path.at("y", output.times)


def panel(top: float, words: str, curves: tuple[FloatArray, FloatArray, FloatArray]) -> list[str]:
    """Measured and followed, and below it the residual on the same scale."""
    times, measured, followed = curves
    high = 1.15 * float(np.max(np.abs(np.concatenate([measured, followed]))))
    above = Axes(60, 836, top, top + 104, (0.0, STOP), (-high, high))
    below = Axes(60, 836, top + 110, top + 160, (0.0, STOP), (-0.5 * high, 0.5 * high))
    return [
        text(60, top - 10, words, "head"),
        *above.rules([-0.2, 0.0, 0.2]),
        above.curve(times, measured, "measured"),
        above.curve(times, followed, "line c1"),
        *below.rules([0.0]),
        below.curve(times, measured - followed, "line c0"),
        *below.numbers(range(9)[:8]),
    ]
