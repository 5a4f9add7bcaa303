"""When a free curve takes the place of named effects."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter
from support.loop_objects import made_fit, made_problem

from cluster_est.closed_loop.selection.single_effect import coloured_criterion
from cluster_est.statistics.records import make_records


class TestColouredCriterion:
    """What eight coefficients seem to be worth that explain nothing, in noise that is coloured."""

    PROBLEM = made_problem(400)
    RECORDS = make_records(PROBLEM.experiments)

    def noise(self, pole: float, seed: int) -> np.ndarray:
        drawn = np.random.default_rng(seed).normal(size=600)
        return lfilter([1.0], [1.0, -pole], drawn)[200:]

    def falls(self, pole: float, signal: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Of both criteria, in 40 draws, where eight cosines are fitted and paid for."""
        waves = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, 400), np.arange(1, 9)))
        price = 8 * np.log(400)
        plain, coloured = [], []
        for seed in range(40):
            values = self.noise(pole, seed)
            values += signal * np.std(values) * waves[:, 2]
            rest = values - waves @ np.linalg.lstsq(waves, values)[0]
            before, after = made_fit(self.PROBLEM, values), made_fit(self.PROBLEM, rest)
            plain.append(before.criterion(self.RECORDS) - after.criterion(self.RECORDS) - price)
            both = [coloured_criterion(f, self.RECORDS, 2) for f in (before, after)]
            coloured.append(both[0] - both[1] - price)
        return np.array(plain), np.array(coloured)

    def test_white_noise_is_worth_nothing_to_either(self):
        plain, coloured = self.falls(0.0)
        assert (plain < 0.0).all()
        assert (coloured < 0.0).all()

    def test_coloured_noise_looks_like_an_effect_to_the_plain_one_alone(self):
        plain, coloured = self.falls(0.95)
        assert np.mean(plain > 0.0) > 0.9
        assert (coloured < 0.0).all()

    def test_what_is_there_is_seen_by_both(self):
        plain, coloured = self.falls(0.5, signal=2.0)
        assert (plain > 0.0).all()
        assert (coloured > 0.0).all()
