"""Mechanical front-wheel drive: an axle that its clutch has left behind pulls nothing, whatever the configuration says.

The truth is the rear-driven tractor, whose front wheels roll freely; the configuration has a shaft to both axles.
"""

import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fakes import feed_message
from soilbus.can.dbc_files import load_databases
from soilbus.config.file import parse_config
from soilbus.decision.capability import assess
from soilbus.decision.driveline import idle
from soilbus.estimation.assembly import model_of, rig_of, with_disengaged
from soilbus.estimation.instrumentation import completed, recompleted
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import Intake
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.soils import soil_named
from soilbus.trials.windows import bins_of

TRUTH = reference_configuration(path=REFERENCES["tractor-2wd"])


def with_a_shaft_to_both_axles(lead: float = 1.0):
    """The rear motor as that of both axles, geared so that they turn alike; lead: of the front wheels' rims."""
    raw = tomllib.loads(REFERENCES["tractor-2wd"].read_text())
    rear = raw["axle"][0]
    radius = {wheel["axle"]: wheel["radius"] for wheel in raw["wheel"]}
    load = {"name": "rear", "differential": "open", "load": rear.pop("load")}
    front = {"name": "front", "differential": "open", "gear_ratio": radius["front"] / radius["rear"] / lead}
    raw["axle"] = [rear | {"name": "both", "differential": "locked"}, load, front]
    for wheel in raw["wheel"]:
        wheel.pop("driven", None)
    return parse_config(raw, REFERENCES["tractor-2wd"].parent)


def largest_draft(truth, config, seed: int):
    """Of the last window of a drive on loam."""
    intake = Intake(config, load_databases(config))
    for message in frames(simulate(truth, excited("loam", 14.5), seed), truth):
        feed_message(intake.admission, message)
    intake.ingest()
    estimator = WindowEstimator(config)
    return [estimator.solve(task) for task in intake.finish(message.timestamp)][-1].traversability.max_draft


@cache
def exact_drafts() -> tuple[float, float]:
    """Largest draft [N] on loam with the rear wheels and with all wheels."""
    soil = Posterior(soil_named("loam"), np.zeros((6, 6)))
    limits = ((TRUTH, [0.0, 0.0, np.nan, np.nan]), (with_a_shaft_to_both_axles(), [np.nan] * 4))
    rear, both = (
        assess(soil, rig_of(config), model_of(config), None, np.array(limit), 0.6, 0.5)[0].max_draft.value
        for config, limit in limits
    )
    return rear, both


@pytest.mark.parametrize(("lead", "seed"), [(1.0, 3), (1.05, 4)])
def test_a_front_axle_that_is_not_engaged_does_not_count_for_the_largest_draft(lead, seed):
    rear, both = exact_drafts()
    assert both > 1.5 * rear
    found = largest_draft(TRUTH, with_a_shaft_to_both_axles(lead), seed)
    assert abs(found.value - rear) < 3.0 * np.hypot(found.std, 0.05 * rear)
    assert found.value + 3.0 * found.std < both


@pytest.mark.parametrize("lead", [0.95, 1.0, 1.05])
def test_an_engaged_front_axle_counts_also_where_its_gear_is_not_known_well(lead):
    rear, both = exact_drafts()
    found = largest_draft(with_a_shaft_to_both_axles(), with_a_shaft_to_both_axles(lead), 3)
    assert abs(found.value - both) < 3.0 * found.std
    assert found.value - 3.0 * found.std > rear


def test_a_front_axle_stays_disengaged_while_its_speeds_are_silent():
    config = with_a_shaft_to_both_axles()
    intake = Intake(config, load_databases(config))
    for message in frames(simulate(TRUTH, excited("loam", 10.5), 3), TRUTH):
        feed_message(intake.admission, message)
    intake.ingest()
    window, rig = intake.finish(message.timestamp)[0].window, intake.rig
    apart = idle(window, rig, -np.inf, np.zeros(4, bool))
    assert apart.tolist() == rig.front.tolist()
    silent = replace(window, speed=np.where(rig.front, np.nan, window.speed))
    for before in (apart, np.zeros(4, bool)):
        assert idle(silent, rig, -np.inf, before).tolist() == before.tolist()


def test_a_disengaged_axle_has_the_rows_of_one_that_is_configured_to_roll_freely():
    config = with_a_shaft_to_both_axles()
    wheels = [w.model_copy(update={"driven": w.axle == "rear"}) for w in config.wheel]
    free = config.model_copy(update={"wheel": wheels})
    channels, soil = simulate(TRUTH, excited("loam", 10.5), 3).channels, soil_named("loam")
    engaged, configured = rig_of(config), rig_of(free)
    rig = with_disengaged(config, engaged, engaged.front)
    given = completed(bins_of(config, channels).window(0.0, 10.0), engaged)
    ours = ObservationModel(recompleted(given, engaged, rig), rig, model_of(config), 0.2)
    other = ObservationModel(bins_of(free, channels).window(0.0, 10.0), configured, model_of(free), 0.2)
    assert ours.gain_names == other.gain_names
    assert ours.gain_std == pytest.approx(other.gain_std)
    assert ours.n_rows == other.n_rows
    one, two = (p.linearise(soil, np.zeros(len(p.gain_std)), p.start(soil)) for p in (ours, other))
    assert one.rows == pytest.approx(two.rows, rel=1e-9, abs=1e-9)
    assert one.weighed == pytest.approx(two.weighed, rel=1e-9, abs=1e-12)
    assert one.chi2 == pytest.approx(two.chi2)


def test_each_choice_of_axles_keeps_what_it_has_learned():
    """Four wheels drive, two, and four again: the third part goes on from the first, and knows more than it did."""
    config = with_a_shaft_to_both_axles(1.05)
    intake, estimator = Intake(config, load_databases(config)), WindowEstimator(config)
    trackers, drafts = [], []
    for part, truth in enumerate((config, TRUTH, config)):
        begin = 0.0
        for message in frames(simulate(truth, excited("loam", 18.0), 5 + part), truth):
            begin = begin or message.timestamp
            message.timestamp += 18.0 * part
            feed_message(intake.admission, message)
        intake.ingest()
        found = [estimator.solve(task) for task in intake.due(begin + 18.0 * (part + 1) - 0.2)]
        trackers.append(estimator.tracker)
        drafts.append(found[-1].traversability.max_draft)
    assert trackers[0] is trackers[2] is not trackers[1]
    assert drafts[2].std < drafts[0].std
    assert abs(drafts[2].value - exact_drafts()[1]) < 2.5 * drafts[2].std
    assert drafts[1].value < 0.8 * drafts[2].value
