"""False warnings in the report of decisions: easy and hard drives apart, each with an interval."""

import math

import pytest
from scipy.stats import chi2

from soilbus.trials.bogging_trials import WarningTrial, figures
from soilbus.trials.decisions_report import as_json, decisions_report, poisson_interval
from soilbus.trials.verdict_trials import Reliability

NO_CALLS = Reliability(0, 0, math.nan, math.nan, 0.0, math.nan, 0, 0, 0.0, ())


def test_easy_and_hard_drives_are_reported_apart_with_an_interval():
    counts = {"firm": 0, "harsh": 2, "clods": 1}
    found = [figures(kind, [WarningTrial(kind, 3600.0, n, math.nan, math.nan)]) for kind, n in counts.items()]
    pooled = as_json([], NO_CALLS, found)["false_warnings"]
    assert pooled["easy"] == {
        "hours": 1.0,
        "false": 0,
        "rate": 0.0,
        "least": 0.0,
        "most": pytest.approx(3.69, rel=0.01),
    }
    assert (pooled["hard"]["hours"], pooled["hard"]["false"], pooled["hard"]["rate"]) == (2.0, 3, 1.5)
    said = decisions_report([], NO_CALLS, found).splitlines()
    assert "Easy drives: 0 false in 1.00 h, 0.00 an hour (95 % interval 0.00 to 3.69)." in said
    assert "Hard drives: 3 false in 2.00 h, 1.50 an hour (95 % interval 0.31 to 4.38)." in said


@pytest.mark.parametrize("count", [0, 1, 2, 5, 30])
def test_interval_of_a_count(count):
    exact = (chi2.ppf(0.025, 2 * count) / 2.0 if count else 0.0, chi2.ppf(0.975, 2 * count + 2) / 2.0)  # Garwood 1936
    assert poisson_interval(count) == pytest.approx(exact, rel=1e-9)


def test_the_figures_say_what_they_share_with_the_estimator():
    said = " ".join(decisions_report([], NO_CALLS, []).split())
    assert "simulated with the estimator's own wheel-soil model, noise and priors" in said
    assert "nothing was tuned on" not in said
