"""Where model and data disagree: nowhere where nothing is missing, and there where something was hidden."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from records import recorded as simulated
from soilbus.can.channels import Column
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.model_out import effect_tables
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.where import Disagreement, disagreements
from soilbus.estimation.assembly import prior_of, with_effects
from soilbus.estimation.nuisance_parameters import parameters_of
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

CONFIG = reference_configuration()
AXLES = reference_configuration(path=REFERENCES["tractor-axles"])
AS_IT_IS = "tractor"
MACHINES = {
    AS_IT_IS: CONFIG, "modest draft": reference_configuration(["noise.draft.absolute=400"]), "axle motors": AXLES,
    "loss": with_effects(CONFIG, ["drivetrain_loss=0.15"]),
}  # fmt: skip
SOILS = ("loam", "wet_clay", "dry_sand")


@cache
def recorded(
    soil: str, seconds: float, seed: int, channel: str = "", error=None, config=AS_IT_IS, known=None
) -> Record:
    """A drive; `error` gives what a channel reads too much from times, slips and speeds of the truth."""

    def misread(recording):
        read, truth = recording.channels[channel], recording.truth
        slip, speed = (np.interp(read.t, truth["t"], truth[name]) for name in ("slip.RL", "ground_speed"))
        return {channel: Column(read.t, read.value + error(read.t, slip, speed))}

    at_rates, edit = DiagnosisOptions(instant=0.1), (misread if error else lambda recording: {})
    config, known = MACHINES[config], MACHINES[known or config]
    return simulated(excited(soil, seconds), seed, config=known, truth=config, edit=edit, options=at_rates)


def places(record: Record) -> list[Disagreement]:
    return disagreements([record], fit_model([record], prior_of(CONFIG), ()))


def test_where_nothing_is_missing_no_place_is_reported():
    """Of a hundred tests a drive one is beyond 1 % by chance: all of them together must not be."""
    reported = {seed: places(recorded(SOILS[seed % 3], 40.0, seed)) for seed in range(6)}
    assert {seed: found for seed, found in reported.items() if found} == {}


def test_residuals_smaller_than_the_noise_are_no_disagreement():
    """The draft sensor is ten times as good as its data sheet says."""
    assert places(recorded("loam", 40.0, 2, known="modest draft")) == []


@pytest.mark.parametrize("seed", range(3))
def test_what_a_fit_leaves_open_is_no_disagreement(seed):
    """Fitted to small slips alone, the model is off at great ones by far more than noise: as it says itself."""
    record = recorded(SOILS[seed % 3], 40.0, seed)
    great = record.whole.slip.mean(axis=1) > 0.2
    training, held_out = (record.whole.part(np.flatnonzero(part)) for part in (~great, great))
    assert min(training.n, held_out.n) > 60
    assert places(dataclasses.replace(record, training=training, held_out=held_out)) == []


def too_much_torque(t, slip, speed):
    return np.where(t > 40.0, 250.0, 0.0)


@pytest.mark.parametrize(
    ("channel", "size", "region", "error"),
    [
        ("torque.RL", 250.0, "time", too_much_torque),
        ("sinkage.FR", -0.006, "slip", lambda t, slip, speed: np.where(slip > 0.28, -0.006, 0.0)),
        ("draft", 250.0, "speed", lambda t, slip, speed: np.where(speed > 1.5, 250.0, 0.0)),
    ],
)
def test_a_hidden_error_is_found_at_its_channel_wheel_and_region_and_the_clearest_place_comes_first(
    channel, size, region, error
):
    found = places(recorded("loam", 60.0, 3, channel, error))
    quantity, _, wheel = channel.partition(".")
    assert (found[0].channel, found[0].wheel) == (quantity, wheel)
    thirds = {
        float(place.region.removeprefix(f"{region} ").split("..")[0]): place.size
        for place in found
        if (place.channel, place.wheel) == (quantity, wheel) and place.region.startswith(f"{region} ")
    }
    assert len(thirds) >= 2
    step = thirds[max(thirds)] - thirds[min(thirds)]  # the fit has spread it over the region, relaxation and inertia
    assert 0.4 < step / size < 1.2
    significances = [place.significance for place in found]
    assert significances == sorted(significances)
    assert max(significances) <= 0.01  # of all tests together


def test_regions_of_an_axles_torque_are_of_its_own_wheels():
    """The rear motor reads too much at great slip of the rear wheels; the front right one has slips of its own."""

    def error(t, slip, speed):
        return np.where(slip > 0.25, 1200.0, 0.0)

    record = recorded("loam", 180.0, 3, "torque.rear", error, "axle motors")
    reported = disagreements([record], fit_model([record], prior_of(AXLES), ()))
    found = [p for p in reported if (p.channel, p.wheel) == ("torque", "rear")]
    thirds = [tuple(map(float, p.region[5:].split(".."))) for p in found if p.region.startswith("slip ")]
    of_rear, of_right = record.held_out.slip[:, 2:].mean(axis=1), record.held_out.slip[:, 1]
    edges, others = (np.quantile(slip, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]) for slip in (of_rear, of_right))
    assert len(thirds) >= 2
    for third in thirds:
        i = np.abs(edges[:-1] - third[0]).argmin()
        assert third == pytest.approx(tuple(edges[i : i + 2]), abs=0.01)
        assert third != pytest.approx(tuple(others[i : i + 2]), abs=0.01)


def test_a_place_names_its_recording():
    sound, late = recorded("loam", 60.0, 4), recorded("loam", 60.0, 3, "torque.RL", too_much_torque)
    records = [dataclasses.replace(sound, name="sound.log"), dataclasses.replace(late, name="late.log")]
    found = disagreements(records, fit_model(records, prior_of(CONFIG), ()))
    assert (found[0].channel, found[0].wheel, found[0].log) == ("torque", "RL", "late.log")


def test_an_effect_of_the_configuration_that_the_data_refute_is_a_place(refuted):
    """A loss of 15 +- 2 % where there is none ends at the edge of its range, 7.5 standard deviations away."""
    record, base = refuted
    (found,) = disagreements([record], base)
    assert (found.channel, found.region, found.size) == ("drivetrain_loss", "parameter share", -0.15)
    assert found.significance < 1e-6
    assert base.held == {"drivetrain_loss": ["drag", "viscous", "fading"]}


def test_an_effect_of_the_configuration_that_is_there_is_no_place():
    record, base = beside_loss(recorded("loam", 40.0, 2, config="loss", known=AS_IT_IS))
    assert disagreements([record], base) == []


def beside_loss(record: Record) -> tuple[Record, FittedModel]:
    """The record and its fit under a model that says 0.15 +- 0.02 of a drivetrain's loss, and holds the rest."""
    loss = CATALOGUE["drivetrain_loss"]
    free = [
        dataclasses.replace(f, value=0.15, std=0.02) if f.parameter.name == "share" else dataclasses.replace(f, std=0.0)
        for f in parameters_of(loss, 4)
    ]
    record = record.with_effects([loss], free)
    return record, fit_model([record], prior_of(CONFIG), [loss])


@pytest.fixture(scope="module")
def refuted() -> tuple[Record, FittedModel]:
    return beside_loss(recorded("loam", 40.0, 4))


def test_what_a_fit_holds_at_its_edge_is_written_with_its_prior_std(refuted):
    (table,), _ = effect_tables(refuted[1])
    assert table["share"] == {"value": 0.0, "std": 0.02}
    assert table["drag"] == {"value": 0.0}
