"""The change detector's threshold: noise passes it as often as asked, and not more."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from soilbus.estimation.change_detection import alarm_threshold, log_likelihood_ratio

DRAWS = 20_000


@pytest.mark.parametrize(("instants", "residuals"), [(12, 5), (31, 9), (60, 9)])
def test_noise_passes_the_threshold_as_often_as_asked(instants, residuals):
    rng = np.random.default_rng([instants, residuals])
    count = np.full(instants, float(residuals))
    largest = [log_likelihood_ratio(misfit, count).max() for misfit in rng.chisquare(residuals, (DRAWS, instants))]
    for probability in (0.01, 0.002):
        alarms = np.count_nonzero(np.array(largest) > alarm_threshold(probability, instants, residuals))
        low, high = binom.interval(0.99, DRAWS, probability)
        assert 0.9 * low <= alarms <= high  # the formula is up to a tenth above the rate of draws


def test_a_single_instant_has_the_tail_of_chi_square():
    threshold = alarm_threshold(1e-4, 1, 9)
    q = chi2.isf(1e-4, 9) / 9.0
    assert threshold == pytest.approx(4.5 * (q - 1.0 - np.log(q)), abs=0.02)
