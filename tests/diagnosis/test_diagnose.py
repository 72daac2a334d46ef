"""The soil's std after effects were added: an effect that changed it much may have changed it wrongly."""

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.gap import Gap
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import Verdict, mean_soil_error_share, soil_error_share
from soilbus.estimation.posterior import Posterior
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import soil_named

LOAM = soil_named("loam")
COVARIANCE = np.diag([0.3, 0.02, 0.01, 0.005, 0.1, 0.02]) ** 2


def diagnosis(before: Posterior, after: Posterior, left: float = 0.125) -> Diagnosis:
    base, completed = (SimpleNamespace(fits=[SimpleNamespace(posterior=p)]) for p in (before, after))
    added = Addition(CATALOGUE["grade"], 1.0, {}, {"grade": 90.0}, soil_error_share=left)
    return Diagnosis(Verdict.NAMED, (), (added,), base, completed, (), Gap(1.5, 900), Gap(1.0, 900))


def test_a_soil_that_stays_is_as_sure_as_the_fit_says():
    after = Posterior(LOAM, COVARIANCE)
    reported = diagnosis(Posterior(LOAM, 4.0 * COVARIANCE), after).soil_after(0)
    assert reported.soil == LOAM
    assert np.array_equal(reported.log_covariance, COVARIANCE)


def test_a_share_of_the_change_is_doubted():
    """Of a bearing pressure that was half as great again; K_L in proportion, so that all else stays."""
    before = LOAM._replace(k_c=1.5 * LOAM.k_c, k_phi=1.5 * LOAM.k_phi)
    found = diagnosis(Posterior(before, COVARIANCE), Posterior(LOAM, COVARIANCE))
    fit, reported = (p.bearing_pressure(0.02, 0.3) for p in (Posterior(LOAM, COVARIANCE), found.soil_after(0)))
    assert reported.value == fit.value
    doubt = 0.125 * np.log(1.5) * reported.value
    assert reported.std == pytest.approx(np.hypot(fit.std, doubt), rel=1e-9)
    assert found.soil_after(0).parameters()["phi"] == Posterior(LOAM, COVARIANCE).parameters()["phi"]
    assert found.soil_before(0).soil == before


def test_a_parameter_held_at_zero_stays_known():
    soil = LOAM._replace(c=0.0)
    held = COVARIANCE.copy()
    held[4] = held[:, 4] = 0.0
    moved = soil._replace(k_phi=1.5 * soil.k_phi)
    reported = diagnosis(Posterior(moved, held), Posterior(soil, held)).soil_after(0)
    assert np.isfinite(reported.log_covariance).all()
    assert reported.log_covariance[4, 4] == 0.0
    assert reported.log_covariance[1, 1] > held[1, 1]


def test_an_effect_whose_formula_is_doubted_more_leaves_more_in_proportion_to_its_probability():
    tyre, other = (soil_error_share(name) for name in ("tyre_deflection", "rut_recovery"))
    assert tyre > 4.0 * other
    assert mean_soil_error_share({"rut_recovery": 0.9}) == other
    assert mean_soil_error_share({"rut_recovery": 0.3, "tyre_deflection": 0.3}) == pytest.approx(
        np.sqrt((tyre**2 + other**2) / 2.0)
    )
