"""What loops call is compiled into them, without ways in from Python where numba is known."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from workers.kernels.fmi import compiling
from workers.kernels.fmi.compiling import for_callers, kernel


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


def doubled(value):
    return 2.0 * value


def tripled(value):
    return 3.0 * value


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """The files of two loops, and what both give and whether they are read, once called."""
    monkeypatch.setattr(compiling, "_CACHE_FOLDER", str(tmp_path))

    def call() -> tuple[list[float], list[int]]:
        loops = [kernel(each) for each in (doubled, tripled)]
        return [each(1.5) for each in loops], [sum(e.stats.cache_hits.values()) for e in loops]

    assert call() == ([3.0, 4.5], [0, 0])
    assert call() == ([3.0, 4.5], [1, 1])
    files = sorted(each for each in tmp_path.rglob("*") if each.is_file())
    assert len(files) == 4
    return files, call


def cut(files: list[Path]) -> None:
    for each in files:
        each.write_bytes(each.read_bytes()[:-40])


def empty(files: list[Path]) -> None:
    for each in files:
        each.write_bytes(b"")


def exchange(files: list[Path]) -> None:
    """Of two loops, the one's for the other's."""
    first, second = ([e for e in files if n in e.name] for n in ("doubled", "tripled"))
    for one, other in zip(first, second, strict=True):
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)


class Harm:
    """Says so if it is unpickled."""

    def __reduce__(self) -> Any:
        return pytest.fail, ("unpickled",)


def plant(files: list[Path]) -> None:
    for each in files:
        each.write_bytes(pickle.dumps(Harm()))


def give_away(files: list[Path]) -> None:
    if not hasattr(os, "geteuid") or os.geteuid():
        pytest.skip("only root can give a file to another user")
    for each in files:
        os.chown(each, 54321, 54321)


@pytest.mark.parametrize("harm", [cut, empty, exchange, plant, give_away])
def test_loops_whose_files_were_harmed_are_compiled_anew(kept, harm):
    files, call = kept
    harm(files)
    assert call() == ([3.0, 4.5], [0, 0])
    assert call() == ([3.0, 4.5], [1, 1])


def test_files_that_are_gone_are_made_anew(kept):
    files, call = kept
    for each in files[::2]:
        each.unlink()
    assert call()[0] == [3.0, 4.5]
    assert call() == ([3.0, 4.5], [1, 1])
