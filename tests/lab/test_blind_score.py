"""The score of the blind test: the generator decides what is visible, and no failure leaves the denominator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.simulator.scenario import Patch
from soilbus.terra.soils import soil_named
from tests.golden.outputs import the_case
from tests.lab.blind import __main__ as command
from tests.lab.blind import trial as trials
from tests.lab.blind.calibration import curve, draw, stated
from tests.lab.blind.cases import Case
from tests.lab.blind.form import Hidden, Setting, by_hooks
from tests.lab.blind.table import figures, report, targets_are_met
from tests.lab.blind.trial import FAILED, Trial, tried
from tests.lab.blind.visible import shown


def shorter(case: Case, seconds: float = 20.0) -> Case:
    return replace(case, scenario=replace(case.scenario, duration=seconds))


PLAIN = Setting(soil_named("loam"), 0.05, np.random.default_rng(1))

# --- what is visible ---


def test_what_soil_or_gains_do_alike_is_not_visible():
    case = shorter(the_case("plain/"))

    def harder(scenario):
        soil = soil_named(case.soil_name)
        return replace(scenario, soils=(Patch(0.0, "harder", soil._replace(k_phi=1.1 * soil.k_phi)),))

    def louder(recording):
        draft = recording.channels["draft"]
        return replace(recording, channels=recording.channels | {"draft": replace(draft, value=1.005 * draft.value)})

    nothing, soil, gain = (
        shown(replace(case, parts=(part,))) for part in (Hidden(), Hidden(way=harder), Hidden(after=louder))
    )
    assert nothing.energy < 0.01
    assert soil.energy < 1.0
    assert 0.1 < gain.energy <= 1.0  # a standard deviation of that gain
    assert max(soil.gap, gain.gap) < 1.001


def test_an_effect_that_nothing_imitates_is_as_visible_as_its_size_over_the_noise():
    """Of a ripple in the torques all is seen that the noise of loads and speeds lets through."""
    case = shorter(the_case("plain/"))
    ripple = by_hooks(torque=lambda torque, around, values: torque * (1.0 + values["size"] * np.sin(6.0 * around.t)))
    small, twice = (shown(replace(case, parts=(ripple(size, PLAIN),))) for size in (0.002, 0.004))
    assert twice.energy == pytest.approx(4.0 * small.energy, rel=0.05)
    per_sample = (0.002**2 / 2.0) / 0.01**2  # mean square over the square of the torque's own noise
    whole = per_sample * 4 * 50 * case.scenario.duration
    assert 0.1 * whole < small.energy < whole
    assert small.gap == pytest.approx(1.0 + small.energy / (200 * (5 + 4 * case.with_sinkage)), rel=0.01)


def test_of_two_effects_the_less_visible_one_counts():
    case = shorter(the_case("plain/"))
    loud = by_hooks(torque=lambda torque, around, values: torque * (1.0 + 0.1 * np.sin(6.0 * around.t)))
    faint = by_hooks(draft=lambda draft, around, values: 8.0 * np.sin(5.0 * np.ravel(around.t)) + 0.0 * draft)
    both, alone = (shown(replace(case, parts=tuple(p(1.0, PLAIN) for p in ps))) for ps in ((loud, faint), (faint,)))
    assert both.energy == pytest.approx(alone.energy, rel=0.3)


# --- what counts ---


def a_trial(**changes: object) -> Trial:
    reported = {"verdict": "named", "named": ("lugs",), "sets": ({"lugs": 1.0},), "falls": ({},), "gap_before": 2.0}
    reported |= {"gap_after": 1.0, "rows": 3000, "bearing_before": 0.1, "bearing_after": 0.01, "bearing_sd": 0.01}
    truth = {"id": "a", "kind": "single", "half": "report", "hidden": ("lugs",), "size": "large", "imitable": False}
    truth |= {"far": False, "visible": 1000.0, "true_gap": 2.0, "seconds": 1.0}
    return Trial(**truth | reported | changes)


GOOD = [a_trial() for _ in range(9)]


@pytest.mark.parametrize(
    ("bad", "missed"),
    [
        (a_trial(verdict="none", named=(), sets=(), gap_after=2.0), 3),
        (a_trial(**FAILED), 3),
        (a_trial(named=("grade",), sets=({"grade": 1.0},)), 1),
        (a_trial(visible=50.0, named=(), sets=()), 1),
        (a_trial(kind="pair", hidden=("lugs", "grade")), 1),
        (a_trial(kind="plain", hidden=(), visible=0.0, true_gap=1.0), 1),
        (a_trial(kind="outside", hidden=(), gap_before=1.0, verdict="none", named=()), 1),
    ],
    ids=["unnamed", "failed", "misnamed", "barely visible", "half a pair", "null named", "outside and unseen"],
)
def test_each_failure_counts(bad: Trial, missed: int):
    assert targets_are_met(GOOD)
    assert not targets_are_met([*GOOD[:5], bad])
    assert report([*GOOD[:5], bad]).count("MISSED") >= missed
    assert targets_are_met([*GOOD, replace(bad, half="tune")])


def test_formulas_far_from_the_catalogue_count_apart():
    far = a_trial(far=True, named=("grade",), sets=({"grade": 1.0},))
    lines = [figure.text for figure in figures([*GOOD, far])]
    assert "visible: named first: 9 of 9 = 100 %  (>= 90 %)" in lines
    assert "visible, by formulas of which the catalogue leaves over 10 %: named first: 0 of 1 = 0 %" in lines
    assert targets_are_met([*GOOD, far])


def test_the_exit_code_says_whether_targets_are_met(monkeypatch, capsys):
    chosen = ["--only", "1.85", "--kind", "single"]
    for found, code in ((a_trial(), 0), (a_trial(named=(), sets=()), 1), (None, 1)):
        monkeypatch.setattr(command, "trials_of", lambda wanted, count, found=found: [(wanted[0], found)])
        assert command.main(chosen) == code
    assert "cannot be driven" in capsys.readouterr().out


def test_a_diagnosis_that_fails_is_a_trial(monkeypatch):
    def fails(*args):
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(trials, "diagnose", fails)
    found = tried(shorter(the_case("single/torque_lag:averaged/medium/"), 30.0))
    assert (found.verdict, found.named) == ("failed", ())
    assert found.visible > 0.0


# --- how often names are right ---


def test_names_of_all_sets_count_but_those_beside_unknown(tmp_path):
    trials = [
        a_trial(sets=({"lugs": 0.9, "grade": 0.05}, {"inertia": 0.85})),
        a_trial(verdict="unknown", sets=({"lugs": 0.9},), hidden=()),
        a_trial(verdict="none", sets=()),
    ]
    assert sorted(stated(trials)) == [(0.05, False), (0.85, False), (0.9, True)]
    draw(curve(stated(trials)), str(tmp_path / "curve.svg"))
    assert (tmp_path / "curve.svg").read_text().startswith("<?xml")


def test_names_that_are_right_as_often_as_stated_lie_on_the_diagonal():
    rng = np.random.default_rng(4)
    probabilities = rng.uniform(0.02, 1.0, 20000)
    found = curve(zip(probabilities.tolist(), (rng.uniform(size=20000) < probabilities).tolist(), strict=True))
    assert sum(one.names for one in found) == 20000
    for one in found:
        assert one.right / one.names == pytest.approx(one.stated, abs=4.0 * np.sqrt(0.25 / one.names))
        assert one.low < one.right / one.names < one.high
