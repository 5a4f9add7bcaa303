"""What loops call is compiled into them, without ways in from Python where numba is known."""

import os
import pickle

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


def summed(options, values):
    """A sum whose terms are computed by another function, both compiled."""

    @njit(nogil=True, _nrt=False, **options)
    def term(value):
        return float(abs(value) ** 0.5 * value)

    @njit(nogil=True, _nrt=False)
    def total(values):
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

    def call():
        loops = [kernel(each) for each in (doubled, tripled)]
        return [each(1.5) for each in loops], [sum(e.stats.cache_hits.values()) for e in loops]

    assert call() == ([3.0, 4.5], [0, 0])
    assert call() == ([3.0, 4.5], [1, 1])
    files = sorted(each for each in tmp_path.rglob("*") if each.is_file())
    assert len(files) == 4
    return files, call


def rewritten(change):
    """Harm that changes what is in each file."""

    def harm(files):
        for each in files:
            each.write_bytes(change(each.read_bytes()))

    return harm


def exchange(files):
    """Of two loops, the one's for the other's."""
    first, second = ([e for e in files if n in e.name] for n in ("doubled", "tripled"))
    for one, other in zip(first, second, strict=True):
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)


class Harm:
    """Says so if it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("unpickled",)


def give_away(files):
    if not hasattr(os, "geteuid") or os.geteuid():
        pytest.skip("only root can give a file to another user")
    for each in files:
        os.chown(each, 54321, 54321)


CUT, EMPTY = rewritten(lambda content: content[:-40]), rewritten(lambda content: b"")
PLANTED = rewritten(lambda content: pickle.dumps(Harm()))


@pytest.mark.parametrize("harm", [CUT, EMPTY, exchange, PLANTED, give_away])
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
