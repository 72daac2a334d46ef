"""Text, JSON and page of diagnoses that are not clear: a set of names, a gap without a name, numbers that are none."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from records import recorded
from soilbus.diagnosis.detectable import Detectable
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.gap import Gap
from soilbus.diagnosis.residual_terms import WARNING, ResidualTerms, Term
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import Verdict
from soilbus.diagnosis.where import Disagreement
from soilbus.estimation.assembly import prior_of
from soilbus.offline.diagnose import Findings
from soilbus.offline.recordings import Recordings
from soilbus.report.diagnosis import diagnosis_report
from soilbus.report.findings import findings_json, findings_text
from soilbus.report.page import Source
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

CONFIG = reference_configuration()
OFFSET = Addition(CATALOGUE["draft_offset"], 0.6, {"grade": 0.3, "bulldozing": 0.1}, {
    "draft_offset": np.array([52.0]), "grade": np.array([48.0]), "bulldozing": np.array([41.0]),
    "lugs": np.array([2.0]),
})  # fmt: skip


@pytest.fixture(scope="module")
def findings() -> Findings:
    """A plain drive, said to be ambiguous."""
    record = recorded(excited("loam", 24.0), 2, name="<a & b>.log")
    base, completed = (fit_model([record], prior_of(CONFIG), effects) for effects in ((), (OFFSET.effect,)))
    where = (
        Disagreement("draft", "", "slip 0.20..0.35", 312.0, significance=0.0),
        Disagreement("load", "FL", "gain", 0.031, significance=1e-5),
    )
    diagnosis = Diagnosis(Verdict.AMBIGUOUS, where, (OFFSET,), base, completed, (), Gap(1.234, 900), Gap(1.012, 900))
    recordings = Recordings((record,), (0,), 1234, {"bad_checksum": 7}, ("<a & b>.log, part 2",))
    return Findings(diagnosis, recordings, CONFIG, 1.5)


def with_verdict(findings: Findings, verdict: Verdict, **changes) -> Findings:
    return dataclasses.replace(findings, diagnosis=dataclasses.replace(findings.diagnosis, verdict=verdict, **changes))


def unknown(findings: Findings) -> Findings:
    learned = ResidualTerms("torque", "RL", (Term("1", 3.0), Term("sin(1 wheel angle)", -120.0)), 0.83)
    return with_verdict(
        findings, Verdict.UNKNOWN, additions=(), completed=findings.diagnosis.base, residual_terms=(learned,)
    )


def page_of(findings: Findings) -> str:
    return diagnosis_report(
        findings, Source(CONFIG, logs=[Path(record.name) for record in findings.recordings.records])
    )


@pytest.fixture(scope="module")
def page(findings: Findings) -> str:
    return page_of(findings)


@pytest.fixture(scope="module")
def page_of_unknown(findings: Findings) -> str:
    return page_of(unknown(findings))


def test_a_set_is_reported_with_probabilities_reason_and_what_would_separate_it(findings):
    text = findings_text(findings)
    assert "1. draft_offset, probability 0.60\n" in text
    assert "or: grade 0.30, bulldozing 0.10" in text
    assert "draft_offset lowers -2 log evidence by 52, grade by 48, bulldozing by 41" in text
    for name in ("draft_offset", "grade", "bulldozing"):
        assert f"- {name}: {CATALOGUE[name].tells}\n" in text
    assert "draft, slip 0.20..0.35: reading less model +312 N (chance < 1e-300)" in text
    assert "load.FL, gain: an implausible gain error of +3.10 % (chance 1e-05)" in text
    assert "1234 samples of one log; refused samples: bad_checksum 7; too short to use: <a & b>.log, part 2" in text


def test_a_set_in_json(findings):
    effect = json.loads(findings_json(findings))["effects"][0]
    assert effect["alternatives"] == [{"name": "grade", "probability": 0.3}, {"name": "bulldozing", "probability": 0.1}]
    assert effect["tells"].keys() == {"draft_offset", "grade", "bulldozing"}
    assert "alike" in effect["why_ambiguous"]


def test_what_has_no_name_is_described_with_a_warning(findings, page_of_unknown):
    text, reported = findings_text(unknown(findings)), json.loads(findings_json(unknown(findings)))
    assert text.startswith("unknown: ")
    line = "torque.RL: reading less model = +3 -120 sin(1 wheel angle) [N m] (83 % of the held-out excess)"
    assert line in text
    assert WARNING in text
    assert reported["warning"] == WARNING
    assert reported["learned"][0]["terms"] == {"1": 3.0, "sin(1 wheel angle)": -120.0}
    assert line in page_of_unknown


def test_pages_show_names_as_text_and_pictures_of_before_alone_where_nothing_was_added(page, page_of_unknown):
    plain = page_of_unknown
    assert "soilbus diagnose · &lt;a &amp; b&gt;.log</p>" in page
    assert "<a & b>" not in page
    added, left = (re.findall('<img alt="([^"]*)"', text) for text in (page, plain))
    assert [t.split(":")[0] for t in added if t.startswith(("Before", "After"))] == ["Before", "After"] * 3
    assert not any(t.startswith(("Before", "After")) for t in left)
    assert "Missing from the model: draft_offset, grade or bulldozing</h1>" in page
    assert "Missing: something that the catalogue does not have</h1>" in plain


def test_what_is_not_finite_is_null(findings):
    check = dataclasses.replace(findings.diagnosis.base.checks[0], chi2=float("nan"))
    base = dataclasses.replace(findings.diagnosis.base, checks=(check,))
    place = Disagreement("draft", "", "everywhere", float("inf"), 0.0)
    reported = findings_json(with_verdict(findings, Verdict.AMBIGUOUS, base=base, where=(place,)))
    assert json.loads(reported, parse_constant=pytest.fail)["where"][0]["size"] is None


def test_page_text_and_json_say_the_same_of_what_could_be_seen(findings):
    soil_error = np.log(0.8) * np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    seen = (
        Detectable(CATALOGUE["torque_lag"], 0.04, 0.04, 0.0 * soil_error),
        Detectable(CATALOGUE["slip_sinkage"], None, 1.2, soil_error),
    )
    base = findings.diagnosis.base
    none = with_verdict(findings, Verdict.NONE, additions=(), where=(), completed=base, detectable=seen)
    reported, text, page_of_none = json.loads(findings_json(none)), findings_text(none), page_of(none)
    assert reported["could_show"] == [{"name": "torque_lag", "parameter": "delay", "unit": "s", "size": 0.04}]
    assert reported["could_not_show"] == ["slip_sinkage"]
    (feared,) = reported["unseen"]
    assert (feared["name"], feared["size"]) == ("slip_sinkage", 1.2)
    assert feared["bearing_pressure_error"] == pytest.approx(-0.2)
    assert feared["bearing_pressure_std"] < 0.2
    for line in (
        reported["sentence"],
        "slip_sinkage 1.2 by -20.0 %",
        "could not have shown, at any usual size: slip_sinkage",
    ):
        assert line in text
        assert line in page_of_none
    asked = json.loads(findings_json(findings))
    assert asked["could_show"] is asked["could_not_show"] is asked["unseen"] is None


def test_json_says_whether_a_gap_is_left_and_why_names_are_near_each_other(findings):
    reported = json.loads(findings_json(findings))
    assert reported["gap"]["open"] is False
    assert "random weights of the blocks" in reported["effects"][0]["why_probabilities"]
    assert reported["effects"][0]["why_probabilities"] in findings_text(findings)
    left = json.loads(findings_json(with_verdict(findings, Verdict.AMBIGUOUS, gap_after=Gap(1.5, 900))))
    assert left["gap"]["open"] is True
    assert "something is left besides" in left["sentence"]


def test_a_small_offset_of_the_hitch_may_as_well_be_one_of_the_pitch_sensor(findings):
    """As m g sin(slope) is the same push; a great one is beyond what a pitch sensor is ever off by."""
    reported = json.loads(findings_json(findings))["effects"][0]
    offset = reported["parameters"]["offset"]["value"]
    slope = np.degrees(offset / (CONFIG.vehicle.mass * 9.80665))
    assert reported["same_as"] == (
        f"a pitch sensor that reads {abs(slope):.2f} deg too {'high' if slope > 0.0 else 'low'} would do the same"
    )
    assert reported["same_as"] in findings_text(findings)
    completed = findings.diagnosis.completed
    place = completed.checks[-1].problem.n_sensors
    gains = completed.fits[-1].mode.gains.copy()
    gains[place] = 500.0 / completed.free[0].std
    fit = dataclasses.replace(completed.fits[-1], mode=dataclasses.replace(completed.fits[-1].mode, gains=gains))
    great = with_verdict(findings, Verdict.AMBIGUOUS, completed=dataclasses.replace(completed, fits=(fit,)))
    assert json.loads(findings_json(great))["effects"][0]["same_as"] is None
