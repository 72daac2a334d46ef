"""No diagnosis contradicts itself: verdict, gap, places, what could be seen and how sure the soil is."""

import dataclasses
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.diagnosis.detectable import Detectable
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.gap import Gap
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import Verdict, mean_soil_error_share, probabilities, soil_error_share, verdict_of
from soilbus.diagnosis.where import Disagreement
from soilbus.estimation.posterior import Posterior
from soilbus.report.findings import place_lines
from soilbus.report.statement import doubt, headline, shown_lines, statement, why_probabilities
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import soil_named

CONFIG = reference_configuration()
PLACE = Disagreement("draft", "", "slip 0.20..0.35", 312.0, significance=1e-5)
SOIL = Posterior(soil_named("loam"), np.diag([0.3, 0.02, 0.01, 0.005, 0.1, 0.02]) ** 2)
NOTHING = SimpleNamespace(fits=[SimpleNamespace(posterior=SOIL)], converged=True, at_limits=(), held={})
OPEN_END = SimpleNamespace(fits=NOTHING.fits, converged=False, at_limits=(), held={})
NAMES = sorted(CATALOGUE)


def addition(name: str, chance: float) -> Addition:
    return Addition(CATALOGUE[name], chance, {}, {name: 50.0})


def shown(name: str, size: float | None, error: float = 0.0) -> Detectable:
    """An effect whose unseen size moves the soil's moduli, and so the pressure, by a relative error."""
    return Detectable(CATALOGUE[name], size, size or 1.0, np.log1p(error) * np.array([[1.0, 1.0, 0, 0, 0, 0]]))


@st.composite
def diagnoses(draw) -> Diagnosis:
    names = draw(st.lists(st.sampled_from(NAMES), unique=True, max_size=3))
    chances = [draw(st.floats(0.05, 1.0)) for _ in names]
    rows = draw(st.integers(20, 20000))
    before = Gap(draw(st.floats(0.95, 9.0)), rows)
    after = Gap(draw(st.floats(0.9, 1.0)) + draw(st.floats(0.0, 1.0)) ** 3 * (before.value - 0.9), rows)
    imitation = (0.9, 0.6, 0.1) if len(names) == 3 and draw(st.booleans()) else ()
    gaps = before.value, (after if names else before).value
    verdict = verdict_of(*gaps, rows, chances, bool(imitation))
    where = draw(st.sampled_from([(), (PLACE,), (PLACE, PLACE)]))
    seen = tuple(shown(n, draw(st.sampled_from([None, 0.1]))) for n in NAMES) if verdict is Verdict.NONE else ()
    added = tuple(map(addition, names, chances))
    after = after if names else before
    return Diagnosis(verdict, where, added, NOTHING, NOTHING, (), before, after, imitation, seen)


AGREES = re.compile(r"\bagree\b|nothing is missing|no channel disagrees")
MISSING = re.compile(
    r"(?:effects?|something|more) (?:is|are) missing|is left besides|disagree by more|reading less model"
)


def said(found: Diagnosis) -> str:
    """All sentences about model and data."""
    findings = SimpleNamespace(diagnosis=found, config=CONFIG)
    return "\n".join([statement(found), doubt(found) or "", *place_lines(findings), *shown_lines(found, CONFIG)])


@given(diagnoses())
def test_no_sentence_contradicts_another(found):
    text = said(found)
    assert not (AGREES.search(text) and MISSING.search(text)), text
    agrees = found.verdict is Verdict.NONE and not found.where and not found.gap_after.exceeds_noise()
    assert bool(AGREES.search(text)) == agrees, text
    assert (headline(found) == "Model and data agree") == agrees


@given(diagnoses())
def test_a_gap_that_is_left_is_said_in_the_first_line(found):
    is_unexplained = found.verdict is Verdict.UNKNOWN or found.gap_after.exceeds_noise()
    assert is_unexplained == bool(re.search(r"the gap of|no effect of the catalogue explains", statement(found)))
    assert len(statement(found).splitlines()) == 1


@given(diagnoses())
def test_unknown_beside_names_says_that_these_are_there_and_more(found):
    if found.verdict is Verdict.UNKNOWN and found.additions:
        assert re.search(r"there, .* and more is missing", statement(found))
        assert all(a.effect.name in statement(found) for a in found.additions)


def test_a_named_effect_with_a_gap_left_and_no_place_of_its_own():
    found = Diagnosis(
        Verdict.NAMED, (), (addition("slip_sinkage", 0.97),), NOTHING, NOTHING, (), Gap(2.4, 900), Gap(1.3, 900)
    )
    assert "something is left besides: the gap of 1.30 is above 1.19" in statement(found)
    assert "no single place stands out" in said(found)


def test_effects_that_are_more_together_than_apart_are_doubted_with_what_rules_them_out():
    names = ("tyre_deflection", "rolling_radius", "stress_peak_shift")
    added = tuple(addition(name, 0.9) for name in names)
    found = Diagnosis(
        Verdict.AMBIGUOUS, (PLACE,), added, NOTHING, NOTHING, (), Gap(9.0, 900), Gap(1.0, 900), (0.9, 0.6, 0.1)
    )
    reported = doubt(found) or ""
    assert "tyre_deflection 90 %, rolling_radius 60 %, stress_peak_shift 10 %" in reported
    assert "imitation of something that the catalogue lacks" in reported
    assert 'say tyre = "rigid"' in reported
    assert "tyre_deflection: a rigid wheel has no tyre" in reported
    assert "rolling_radius: a rigid wheel" in reported
    assert verdict_of(9.0, 1.0, 900, [0.9] * 3) is Verdict.NAMED
    assert verdict_of(9.0, 1.0, 900, [0.9] * 3, is_doubtful=True) is Verdict.AMBIGUOUS
    assert doubt(dataclasses.replace(found, imitation=())) is None


def test_a_name_is_as_sure_as_blocks_agree():
    even, uneven = np.full(30, 2.0), np.append(np.full(15, 12.0), np.full(15, -8.0))
    assert probabilities({"a": even})["a"] == pytest.approx(1.0 / (1.0 + len(CATALOGUE) * np.exp(-30.0)))
    assert 0.8 < probabilities({"a": uneven})["a"] < 0.99
    close = probabilities({"a": uneven, "b": uneven[::-1]})
    assert abs(close["a"] - close["b"]) < 0.1
    assert close["a"] + close["b"] < 1.0
    one = Addition(CATALOGUE["lugs"], 0.6, {"b": 0.4}, {"a": uneven, "b": even})
    assert "predicts of blocks that it was not fitted to" in (why_probabilities(one) or "")
    assert why_probabilities(addition("lugs", 1.0)) is None


def test_what_could_not_be_shown_is_reported_with_what_it_does_to_the_soil():
    seen = (shown("torque_lag", 0.04), shown("slip_sinkage", None, -0.2), shown("multipass", 0.03, 0.001))
    found = Diagnosis(Verdict.NONE, (), (), NOTHING, NOTHING, (), Gap(1.0, 900), Gap(1.0, 900), (), seen)
    text = "\n".join(shown_lines(found, CONFIG))
    assert "could have shown, from about these sizes on: torque_lag 0.04 s, multipass 0.03" in text
    assert "could not have shown, at any usual size: slip_sinkage" in text
    std = SOIL.bearing_pressure(0.02, 0.3)
    assert text.splitlines()[-1].startswith("what they could not have shown may move")
    assert f"its +- {100.0 * std.std / std.value:.1f} %: slip_sinkage 1 by -20.0 %" in text
    assert "torque_lag" not in text.splitlines()[-1]
    assert "multipass" not in text.splitlines()[-1]


def test_names_beside_a_present_model_that_did_not_converge_are_no_finding():
    added = (addition("bulldozing", 1.0),)
    gaps = Gap(2.6, 900), Gap(0.9, 900)
    before = Diagnosis(Verdict.AMBIGUOUS, (PLACE,), added, OPEN_END, NOTHING, (), *gaps)
    assert "the fit of the present model did not converge" in (doubt(before) or "")
    assert doubt(Diagnosis(Verdict.NAMED, (PLACE,), added, NOTHING, OPEN_END, (), *gaps)) is None
    assert doubt(Diagnosis(Verdict.NAMED, (PLACE,), added, NOTHING, NOTHING, (), *gaps)) is None


@pytest.mark.parametrize("gap", [math.inf, math.nan])
def test_a_gap_that_is_no_number_is_unknown_and_not_none(gap):
    assert verdict_of(gap, gap, 500, []) is Verdict.UNKNOWN
    assert verdict_of(2.0, gap, 500, [0.99]) is Verdict.UNKNOWN


@pytest.mark.parametrize("names", [(), ("lugs",)])
def test_what_the_configuration_holds_is_said_where_something_is_missing(names):
    """A delay that the configuration holds is no candidate, so the catalogue may well explain what is missing."""
    holds = SimpleNamespace(**(vars(NOTHING) | {"held": {"channel_lag": ["ground_speed_delay", "draft_delay"]}}))
    gaps = Gap(2.6, 900), Gap(1.9, 900)
    found = Diagnosis(Verdict.UNKNOWN, (), tuple(addition(n, 0.9) for n in names), holds, holds, (), *gaps)
    assert "no effect that was tried explains" in statement(found)
    assert "catalogue" not in statement(found) + headline(found)
    assert "not tried: channel_lag (ground_speed_delay, draft_delay)" in (doubt(found) or "")
    agreeing = Diagnosis(Verdict.NONE, (), (), holds, holds, (), Gap(1.0, 900), Gap(1.0, 900))
    assert doubt(agreeing) is None


def test_sizes_that_would_have_shown_are_not_said_to_be_unseen():
    """What is shown from 0.98 on may move the soil where it is just below that."""
    found = Diagnosis(Verdict.NONE, (), (), NOTHING, NOTHING, (), Gap(1.0, 900), Gap(1.0, 900), ())
    near = dataclasses.replace(found, detectable=(shown("multipass", 0.98, 1.1),))
    assert list(shown_lines(near, CONFIG))[-1].startswith("sizes just below these may move")
    both = dataclasses.replace(found, detectable=(*near.detectable, shown("slip_sinkage", None, -0.2)))
    assert list(shown_lines(both, CONFIG))[-1].startswith("sizes just below these and what they could not have shown")


# --- the soil's std after effects were added ---

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
