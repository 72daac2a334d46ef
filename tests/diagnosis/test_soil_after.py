"""How sure the soil is told after effects were added: an effect that changed it much may have changed it wrongly."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis.diagnose import FORM_LEFT_IN_SOIL, Diagnosis
from soilbus.diagnosis.gap import Gap
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.posterior import Posterior
from soilbus.terra.soils import soil_named

LOAM = soil_named("loam")
COVARIANCE = np.diag([0.3, 0.02, 0.01, 0.005, 0.1, 0.02]) ** 2


def diagnosis(before: Posterior, after: Posterior) -> Diagnosis:
    base, completed = (SimpleNamespace(fits=[SimpleNamespace(posterior=p)]) for p in (before, after))
    return Diagnosis(Verdict.NAMED, (), (), base, completed, (), Gap(1.5, 900), Gap(1.0, 900))


def test_a_soil_that_stays_is_as_sure_as_the_fit_says():
    after = Posterior(LOAM, COVARIANCE)
    told = diagnosis(Posterior(LOAM, 4.0 * COVARIANCE), after).soil_after(0)
    assert told.soil == LOAM
    assert np.array_equal(told.log_covariance, COVARIANCE)


def test_a_share_of_the_change_is_doubted():
    """Of a bearing pressure that was half as great again; K_L in proportion, so that all else stays."""
    before = LOAM._replace(k_c=1.5 * LOAM.k_c, k_phi=1.5 * LOAM.k_phi)
    found = diagnosis(Posterior(before, COVARIANCE), Posterior(LOAM, COVARIANCE))
    fit, told = (p.bearing_pressure(0.02, 0.3) for p in (Posterior(LOAM, COVARIANCE), found.soil_after(0)))
    assert told.value == fit.value
    doubt = FORM_LEFT_IN_SOIL * np.log(1.5) * told.value
    assert told.std == pytest.approx(np.hypot(fit.std, doubt), rel=1e-9)
    assert found.soil_after(0).parameters()["phi"] == Posterior(LOAM, COVARIANCE).parameters()["phi"]
    assert found.soil_before(0).soil == before
