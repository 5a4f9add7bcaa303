"""The nonlinear regressions of NIST's Statistical Reference Datasets, as problems.

https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml. The files in `nist_data/` hold NIST's data,
both starts and the certified values and standard deviations (11 digits); as a work of the
government of the United States they are in the public domain. The models are written from NIST's
formulas.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from support.problems.functions import FunctionProblem

FOLDER = Path(__file__).parent / "nist_data"


@dataclass(frozen=True)
class Regression:
    """One data set; `data` has a row for each observation: y, then x."""

    name: str
    starts: tuple[tuple[float, ...], tuple[float, ...]]
    certified: np.ndarray
    sum_of_squares: float
    data: np.ndarray

    def residuals(self, b: np.ndarray) -> np.ndarray:
        """Measured minus modelled; Nelson's model is of the logarithm."""
        y = np.log(self.data[:, 0]) if self.name == "Nelson" else self.data[:, 0]
        return y - MODELS[self.name](np.asarray(b, np.float64), *self.data[:, 1:].T)

    def problem(self, start: int) -> FunctionProblem:
        """From NIST's start 1, which is far away, or 2, which is near."""
        begin = self.starts[start - 1]
        return FunctionProblem(self.name, self.residuals, begin, self.sum_of_squares)

    def digits(self, b: np.ndarray) -> float:
        """The correct digits of the worst parameter: -log10 of its relative error."""
        with np.errstate(divide="ignore"):
            return float(-np.log10(np.max(np.abs(b / self.certified - 1.0))))


def read(name: str) -> Regression:
    lines = [line.split() for line in (FOLDER / f"{name}.txt").read_text().splitlines()]
    named = {words[0]: words[1:] for words in lines if words[0][0].isalpha()}
    table = np.array([named[key] for key in named if key.startswith("b")], np.float64)
    rows = [words for words in lines if words[0][0] != "#" and words[0] not in named]
    first, second = (tuple(column.tolist()) for column in table[:, :2].T)
    return Regression(
        name,
        (first, second),
        table[:, 2],
        float(named["sum_of_squares"][0]),
        np.array(rows, np.float64),
    )


def rational(b: np.ndarray, x: np.ndarray, above: int) -> np.ndarray:
    """A polynomial with `above` coefficients over one that begins with 1."""
    return np.polyval(b[:above][::-1], x) / np.polyval([*b[above:][::-1], 1.0], x)


def enso(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    year, first, second = (2.0 * np.pi * x / period for period in (12.0, b[3], b[6]))
    waves = (b[1], b[2], year), (b[4], b[5], first), (b[7], b[8], second)
    return b[0] + sum(c * np.cos(angle) + s * np.sin(angle) for c, s, angle in waves)


def gauss(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    bells = [height * np.exp(-(((x - at) / width) ** 2)) for height, at, width in (b[2:5], b[5:])]
    return b[0] * np.exp(-b[1] * x) + bells[0] + bells[1]


def lanczos(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x)


def saturation(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return b[0] * (1.0 - np.exp(-b[1] * x))


def chwirut(b: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


MODELS: dict[str, Callable[..., np.ndarray]] = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1.0 / b[2]),
    "BoxBOD": saturation,
    "Chwirut1": chwirut,
    "Chwirut2": chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": gauss,
    "Gauss2": gauss,
    "Gauss3": gauss,
    "Hahn1": partial(rational, above=4),
    "Kirby2": partial(rational, above=3),
    "Lanczos1": lanczos,
    "Lanczos2": lanczos,
    "Lanczos3": lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Misra1a": saturation,
    "Misra1b": lambda b, x: b[0] * (1.0 - (1.0 + b[1] * x / 2.0) ** -2.0),
    "Misra1c": lambda b, x: b[0] * (1.0 - (1.0 + 2.0 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1.0 + b[1] * x),
    "Nelson": lambda b, t, celsius: b[0] - b[1] * t * np.exp(-b[2] * celsius),
    "Rat42": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)) ** (1.0 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "Thurber": partial(rational, above=4),
}
