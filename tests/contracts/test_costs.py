"""What every cost must do. A new cost is picked up by being registered."""

import dataclasses
import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cluster_est.problem.costs import COSTS, Cost

RESIDUALS = arrays(np.float64, st.integers(1, 50), elements=st.floats(-1e3, 1e3))
NORMAL = np.random.default_rng(3).normal(size=60)
OUTPUTS = np.repeat([0, 1, 2], 20)


GROWS = "larger residuals must cost more: F may not be constant, or fall"
NUMBERS = (
    "compute `value` and `weights` so that they are no NaN, and silence the overflow of huge "
    'residuals: with np.errstate(over="ignore")'
)


def outputs_of(residuals):
    return np.arange(len(residuals)) % 3


def written(base=Cost):
    """All costs of the room that are no base of others."""
    for kind in base.__subclasses__():
        yield from written(kind)
        if kind.__module__ == "cluster_est.problem.costs" and not inspect.isabstract(kind):
            yield kind


def test_every_cost_is_registered_under_a_name_of_its_own():
    missing = [kind.__name__ for kind in written() if kind not in COSTS.values()]
    assert missing == [], "COSTS lacks it: add it there, with a `name` that no other cost has"


@pytest.mark.parametrize("kind", COSTS.values(), ids=lambda k: k.name)
class TestCost:
    def test_its_options_are_the_fields_of_a_dataclass(self, kind):
        own = vars(kind).get("__dataclass_params__")
        assert getattr(own, "frozen", False), "write @dataclass(frozen=True) above it"
        missing = dataclasses.MISSING
        named = dataclasses.fields(kind)
        bare = [f.name for f in named if f.default is f.default_factory is missing]
        assert bare == [], "each option needs a default, as in scale: float = field(default=1.0)"

    def test_no_residuals_at_all_cost_nothing(self, kind):
        """As in a pure search for a point that satisfies constraints."""
        nothing, outputs = np.zeros(0), np.zeros(0, int)
        assert kind().value(nothing, outputs) == 0.0, "no residuals must cost 0"
        weights = kind().weights(nothing, outputs)
        assert weights is None or weights.shape == (0,), "return one weight for each residual"

    @given(residuals=RESIDUALS, seed=st.integers(0, 100))
    def test_order_is_irrelevant(self, kind, residuals, seed):
        outputs = outputs_of(residuals)
        order = np.random.default_rng(seed).permutation(len(residuals))
        shuffled = kind().value(residuals[order], outputs[order])
        plain = kind().value(residuals, outputs)
        assert shuffled == pytest.approx(plain, rel=1e-10, abs=1e-9), (
            "only `outputs` says what belongs together: no residual's place may matter"
        )

    @given(residuals=RESIDUALS, factor=st.floats(1.1, 10.0))
    def test_larger_residuals_cost_more(self, kind, residuals, factor):
        outputs = outputs_of(residuals)
        size = np.abs(residuals)
        small, large = kind().value(size, outputs), kind().value(factor * size, outputs)
        assert small <= large or small == pytest.approx(large, rel=1e-12), GROWS
        size = np.abs(NORMAL)
        assert kind().value(2.0 * size, OUTPUTS) > kind().value(size, OUTPUTS), GROWS

    @pytest.mark.parametrize("size", [0.0, 1e-300, 1e-20, 1e20, 1e100, 1e300])
    def test_residuals_of_any_size_have_a_cost_and_weights(self, kind, size):
        """Infinite at most, and without a warning: a simulation that runs away is no crash."""
        residuals = size * np.abs(NORMAL)
        try:
            value, weights = (of(residuals, OUTPUTS) for of in (kind().value, kind().weights))
        except RuntimeWarning as warning:
            pytest.fail(f"{NUMBERS} ({warning})")
        assert not np.isnan(value), NUMBERS
        assert weights is None or not np.isnan(weights).any(), NUMBERS

    def test_without_numbers_all_residuals_are_of_one_output(self, kind):
        """As where a Python function returns them (`cost.function`)."""
        nobody_knows, one = np.zeros(0, np.int64), np.zeros(60, np.int64)
        said = "take all residuals for those of one output where `outputs` is empty"
        assert kind().value(NORMAL, nobody_knows) == kind().value(NORMAL, one), said
        weights, expected = (kind().weights(NORMAL, outputs) for outputs in (nobody_knows, one))
        if expected is None:
            assert weights is None, said
        else:
            np.testing.assert_array_equal(weights, expected, err_msg=said)

    def test_weights_give_the_gradient(self, kind):
        weights = kind().weights(NORMAL, OUTPUTS)
        if weights is None:
            pytest.skip(f"{kind.name} is no cost for a least-squares method")
        for i in range(0, 60, 7):
            moved = np.tile(NORMAL, (2, 1))
            moved[:, i] += (1e-6, -1e-6)
            high, low = (kind().value(row, OUTPUTS) for row in moved)
            expected = 2.0 * weights[i] * NORMAL[i]
            assert (high - low) / 2e-6 == pytest.approx(expected, rel=1e-5, abs=1e-6), (
                "the gradient of F must be 2 w r: a weight w is dF/dr / (2 r)"
            )

    def test_a_strided_row_gives_the_same_bits(self, kind):
        batch = np.random.default_rng(0).normal(size=(60, 7))
        for row in range(7):
            strided, copied = batch[:, row], np.array(batch[:, row])
            assert kind().value(strided, OUTPUTS) == kind().value(copied, OUTPUTS), (
                "sum with np.add.reduce over np.ascontiguousarray(residuals)"
            )
