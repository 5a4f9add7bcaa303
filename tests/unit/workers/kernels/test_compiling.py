"""What loops call is compiled into them, without ways in from Python where numba is known."""

from typing import Any

import numpy as np
import pytest
from numba import njit

from workers.kernels.fmi.compiling import for_callers


def test_an_unknown_numba_compiles_as_it_always_does_to_the_same_bits():
    known, newer = for_callers((0, 68)), for_callers((99, 0))
    assert "pipeline_class" in known
    assert "pipeline_class" not in newer
    values = np.random.default_rng(0).normal(size=50)
    one, other = (summed(options, values) for options in (known, newer))
    assert one == other
    assert one == pytest.approx(float(np.sum(np.sqrt(np.abs(values)) * values)))


def summed(options: dict[str, Any], values: np.ndarray) -> float:
    """A sum whose terms are computed by another function, both compiled."""

    @njit(nogil=True, _nrt=False, **options)
    def term(value: float) -> float:
        return float(abs(value) ** 0.5 * value)

    @njit(nogil=True, _nrt=False)
    def total(values: np.ndarray) -> float:
        found = 0.0
        for value in values:
            found += term(value)
        return found

    return float(total(values))
