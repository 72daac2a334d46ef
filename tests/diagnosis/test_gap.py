"""The gap over all blocks, each held out in turn, against fits from scratch to each choice of blocks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.gap import Gap, gap_of, gap_of_fold
from soilbus.diagnosis.records import Record, record_of
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.solver import Termination
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)
SECONDS = 36.0
FOLDS = 3


def record_with(effects=()):
    rig, store = rig_of(CONFIG), Bins(rig_of(CONFIG), 0.1, 0.0)
    channels = simulate(CONFIG, excited("loam", SECONDS), 4, effects).channels
    store.add({name: (c.t, c.value) for name, c in channels.items() if name in rig.channels})
    return record_of("drive", store.window(0.0, SECONDS), rig, model_of(CONFIG), 0.2, 0.15)


@pytest.fixture(scope="module")
def record():
    gain = CATALOGUE["draft_gain"]
    return record_with((Active(gain, {"gain": 0.05}),))


@pytest.mark.parametrize("effects", [(), ("draft_gain",)])
def test_the_gap_is_that_of_fits_to_each_choice_of_blocks(record, effects):
    catalogue = [CATALOGUE[name] for name in effects]
    reported = gap_of([record], PRIOR, fit_model([record], PRIOR, catalogue))
    fits = [fit_model([record.with_held_out(fold)], PRIOR, catalogue) for fold in range(FOLDS)]
    rows = [fit.checked_rows for fit in fits]
    assert reported.rows == sum(rows)
    expected = sum(fit.held_out_chi2 * n for fit, n in zip(fits, rows, strict=True)) / sum(rows)
    assert reported.value == pytest.approx(expected, abs=2e-3)
    assert abs(reported.value - 1.0) < 4.0 * math.sqrt(2.0 / reported.rows) or not effects


def test_every_instant_is_held_out_once(record):
    held_out = [record.with_held_out(fold).held_out.t for fold in range(FOLDS)]
    assert np.array_equal(np.sort(np.concatenate(held_out)), record.whole.t)
    assert np.array_equal(held_out[-1], record.held_out.t)
    for fold in range(FOLDS):
        turned = record.with_held_out(fold)
        assert not set(turned.training.t.tolist()) & set(turned.held_out.t.tolist())


def test_where_no_others_can_be_held_out_the_gap_is_of_those_that_are(record):
    """Tables, and a model that did not converge; a gap that a third of the blocks shows is of all folds."""
    found = fit_model([record], PRIOR, ())
    alone = gap_of_fold(found)
    assert alone[:2] == pytest.approx((found.held_out_chi2, found.checked_rows))
    assert gap_of([replace(record, whole=None, fold=None)], PRIOR, found) == alone
    creeping = replace(found, fits=tuple(replace(fit, termination=Termination.LIMIT) for fit in found.fits))
    assert gap_of([record], PRIOR, creeping) == alone
    clear = replace(found, checks=tuple(replace(check, chi2=3.0 * check.rows) for check in found.checks))
    assert gap_of([record], PRIOR, clear).rows > gap_of_fold(clear).rows


@pytest.mark.parametrize("machine", ["tractor-axles", "tractor-2wd"])
def test_where_loads_are_computed_noise_alone_makes_one(machine):
    """And noise twice that of the configuration makes more than noise does: no agreement."""
    sound, noisy = (
        gap_of_drive(machine, ["noise.torque.of_mean=0.02", "noise.draft.absolute=80"] if double else [])
        for double in (False, True)
    )
    assert abs(sound.value - 1.0) < 4.0 * math.sqrt(2.0 * sound.open_loads / sound.rows)
    assert not sound.exceeds_noise()
    assert noisy.exceeds_noise()
    assert noisy.with_open_loads < 1.0 < noisy.open_loads


def test_without_any_load_cell_noise_alone_makes_one_too():
    cells = reference_configuration()
    config = cells.model_copy(update={"wheel": [w.model_copy(update={"load": None}) for w in cells.wheel]})
    record, fitted = weighed(record_of_recording("drive", simulate(config, excited("loam", SECONDS), 4), config))
    found = gap_of([record], PRIOR, fitted)
    assert abs(found.value - 1.0) < 4.0 * math.sqrt(2.0 * found.open_loads / found.rows)
    assert found.with_open_loads < 0.7
    assert not found.exceeds_noise()


def test_a_model_far_off_does_not_hide_in_its_own_weights():
    """A speed 0.4 s late bends the gains so that computed loads seem to leave more open: the shared weights stay."""
    config = reference_configuration(path=REFERENCES["tractor-axles"])
    lag = Active(CATALOGUE["channel_lag"], CATALOGUE["channel_lag"].neutral | {"ground_speed_delay": 0.4})
    made = simulate(config, excited("loam", SECONDS), 4, (lag,))
    _, fitted = weighed(record_of_recording("drive", made, config))
    found = gap_of_fold(fitted)
    assert fitted.held_out_chi2 < 1.5
    assert found.value > 2.0 > found.limit()


def gap_of_drive(machine: str, noise: list[str]) -> Gap:
    """The gap of a machine without load cells, whose sensors have this noise, beside what its configuration says."""
    path = REFERENCES[machine]
    config = reference_configuration(path=path)
    made = simulate(reference_configuration(noise, path=path), excited("loam", SECONDS), 4)
    record, fitted = weighed(record_of_recording("drive", made, config))
    return gap_of([record], PRIOR, fitted)


def weighed(record: Record) -> tuple[Record, FittedModel]:
    """The record with the weights of its fit, which all models share, and the fit with these: as `diagnose` does it."""
    first = fit_model([record], PRIOR, ())
    record = record.with_weights_at(first.fits[0].optimum.at, first.checks[0].at)
    return record, fit_model([record], PRIOR, (), first.as_starts())
