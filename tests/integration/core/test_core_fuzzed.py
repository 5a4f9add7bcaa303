"""Byte code of any content, and FMUs that do anything: the core does no harm and comes to an end.

The long form is scripts/fuzz_core.py.
"""

import shutil
import subprocess

import fuzz_core
import pytest

from workers.core import build
from workers.errors import ModelError

RUNS = 50_000
SANITISED = (*fuzz_core.FLAGS, "-fsanitize=address,undefined", "-std=gnu11")


@pytest.mark.slow
@pytest.mark.parametrize("fuzzer", fuzz_core.FUZZERS)
def test_what_was_found_once_is_mended(tmp_path, fuzzer):
    """Without libFuzzer, so that any compiler with sanitizers will do."""
    binary = tmp_path / fuzzer
    try:
        build.compile_to(binary, fuzz_core.sources(fuzzer, "alone"), SANITISED)
    except ModelError as error:
        if "sanitize" in str(error):
            pytest.skip("this compiler has no sanitizers")
        raise
    known = sorted(map(str, (fuzz_core.KNOWN / fuzzer).iterdir()))
    assert known
    done = subprocess.run(
        [binary, *known], capture_output=True, text=True, check=False, env=fuzz_core.surroundings()
    )
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.slow
@pytest.mark.parametrize("fuzzer", fuzz_core.FUZZERS)
def test_nothing_is_found(tmp_path, fuzzer):
    clang = shutil.which("clang")
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    if clang is None or not fuzz_core.build_fuzzer(clang, fuzzer, tmp_path / fuzzer):
        pytest.skip("clang with libFuzzer is not there: install clang and libclang-rt-dev")
    done = fuzz_core.run_fuzzer(tmp_path / fuzzer, fuzzer, corpus, RUNS, seed=1)
    assert done.returncode == 0, done.stderr[-4000:]
    assert f"Done {RUNS} runs" in done.stderr
