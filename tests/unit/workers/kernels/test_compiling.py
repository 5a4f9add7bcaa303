"""Loops are compiled once, with all that they call; tuples travel by their address."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba import njit

from workers.kernels.fmi.compiling import for_callers, inlined, kernel, subroutine
from workers.kernels.fmi.reference import by_reference
from workers.messages import FloatArray

NEWER = (99, 0)


class Inner(NamedTuple):
    """A tuple in a tuple."""

    values: FloatArray
    active: bool


class Outer(NamedTuple):
    """What is handed on."""

    count: int
    inner: Inner
    other: Inner


def outer(active: bool = True) -> Outer:
    return Outer(3, Inner(np.array([0.1, 0.2, 0.3]), active), Inner(np.zeros(4), False))


@inlined
def _scaled(part: Any, factor: float) -> float:
    total = 0.0
    for value in part.values:
        total += factor * value
    return total


@subroutine
def _fill(given: Any, factor: float, doubled: bool | None = None) -> int:
    """Write through a nested reference; return how many were written."""
    if doubled is not None:
        factor *= 2.0
    for j in range(given.count):
        given.other.values[j] = _scaled(given.inner, factor) if given.inner.active else -1.0
    return int(given.count)


@kernel
def _run(given: Any, factor: float) -> tuple[int, int]:
    given, factor = by_reference((given, factor))
    return _fill(given, factor), _fill(given, factor, True)


@pytest.mark.parametrize(("active", "expected"), [(True, 2.0 * 0.5 * 0.6), (False, -1.0)])
def test_fields_are_read_and_arrays_written_through_references(
    active: bool, expected: float
) -> None:
    given = outer(active)
    assert _run(given, 0.5) == (3, 3)
    np.testing.assert_allclose(given.other.values, [expected] * 3 + [0.0], rtol=1e-15)


def test_a_field_that_a_tuple_does_not_have_is_refused_by_its_name() -> None:
    @kernel
    def wrong(given: Any) -> float:
        (given,) = by_reference((given,))
        return float(given.missing)

    with pytest.raises(numba.TypingError, match="missing"):
        wrong(outer())


def test_an_unknown_numba_compiles_as_it_always_does_to_the_same_bits() -> None:
    assert "pipeline_class" in for_callers((0, 68))
    assert "pipeline_class" not in for_callers(NEWER)
    values = np.random.default_rng(0).normal(size=50)
    one, other = (compiled(for_callers(version))(values) for version in ((0, 68), NEWER))
    assert one == other
    assert one == pytest.approx(float(np.sum(np.sqrt(np.abs(values)) * values)))


def compiled(options: dict[str, Any]) -> Callable[[FloatArray], float]:
    """Compile a sum whose terms are computed by another function."""

    @njit(nogil=True, _nrt=False, **options)
    def term(value: float) -> float:
        return float(abs(value) ** 0.5 * value)

    @njit(nogil=True, _nrt=False)
    def summed(values: FloatArray) -> float:
        total = 0.0
        for value in values:
            total += term(value)
        return total

    return summed  # type: ignore[no-any-return]
