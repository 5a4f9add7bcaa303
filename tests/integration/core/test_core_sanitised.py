"""The core with AddressSanitizer and UndefinedBehaviorSanitizer: nothing is found in any test."""

import pytest
from support.sanitised_core import assert_nothing_is_found

TESTS = (
    "tests/unit/workers/core",
    "tests/integration/core/test_core_loops.py",
    "tests/integration/core/test_core_failures.py",
    "tests/integration/fmus/test_linearisation.py",
    "tests/integration/fmus/test_sensitivities.py",
    "tests/integration/effects/test_effects.py",
    "tests/integration/fits/test_process_noise.py",
)


@pytest.mark.slow
@pytest.mark.parametrize("tests", TESTS)
def test_nothing_is_found(tmp_path, tests):
    assert_nothing_is_found(tmp_path, "core", tests)
