"""Gaussian likelihood whose standard deviations are estimated too, one for each output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.costs.base import Cost
from workers.messages import FloatArray, IntArray

SMALLEST = 1e-300


@dataclass(frozen=True)
class GaussianLikelihood(Cost):
    """F = sum over outputs of n ln(S / n), with S the output's sum of squares over n residuals.

    Twice the negative logarithm of the likelihood, but for a constant, at the most likely standard
    deviations sqrt(S / n): an output with small residuals counts more, whatever its unit. For
    several outputs whose noise is not known. With one output its minimum is that of the sum of
    squares. G. A. F. Seber, C. J. Wild, Nonlinear Regression (1989), doi:10.1002/0471725315,
    section 2.2. What a cost function returns counts as one output.
    """

    name: ClassVar[str] = "likelihood"
    is_logarithm: ClassVar[bool] = True

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        counts, sums = _sums(residuals, _output_numbers(residuals, outputs))
        return float(np.add.reduce(counts * np.log(sums / counts)))

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        outputs = _output_numbers(residuals, outputs)
        counts, sums = _sums(residuals, outputs)
        present = np.unique(outputs)
        table = np.zeros(int(present.max(initial=-1)) + 1)
        table[present] = counts / sums
        return np.asarray(table[outputs])


def _output_numbers(residuals: FloatArray, outputs: IntArray) -> IntArray:
    """Return the output of each residual; one output where none are given."""
    return outputs if len(outputs) else np.zeros(len(residuals), np.int64)


def _sums(residuals: FloatArray, outputs: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the number and the sum of squares of the residuals of each output."""
    parts = [np.ascontiguousarray(residuals[outputs == each]) for each in np.unique(outputs)]
    counts = np.array([len(part) for part in parts], np.float64)
    with np.errstate(over="ignore"):
        sums = np.array([np.add.reduce(part * part) for part in parts], np.float64)
    return counts, np.maximum(sums, SMALLEST)
