"""The gap over all blocks, each predicted from the others, against fits from scratch to each choice of blocks."""

import math
from dataclasses import replace

import numpy as np
import pytest

from records import recorded
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.gap import gap_of
from soilbus.diagnosis.noise_floor import with_noise_floor
from soilbus.diagnosis.records import Record
from soilbus.estimation.assembly import prior_of
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active

CONFIG = reference_configuration()
PRIOR = prior_of(CONFIG)
SECONDS = 36.0
BLOCKS = 9
HALF = ["noise.torque.of_mean=0.005", "noise.draft.absolute=20"]
TWICE = ["noise.torque.of_mean=0.02", "noise.draft.absolute=80"]


def record_with(effects=(), noise=()):
    return recorded(excited("loam", SECONDS), 4, *effects, config=reference_configuration(list(noise)), truth=CONFIG)


@pytest.fixture(scope="module")
def record():
    gain = CATALOGUE["draft_gain"]
    return record_with((Active(gain, {"gain": 0.05}),))


def without(record: Record, block: int) -> Record:
    """The record with this block of 4 s held out."""
    is_held_out = (record.whole.since / 4.0).astype(int) == block
    training, held_out = (record.whole.part(np.flatnonzero(part)) for part in (~is_held_out, is_held_out))
    return replace(record, training=training, held_out=held_out)


@pytest.mark.parametrize("effects", [(), ("draft_gain",)])
def test_the_gap_is_that_of_fits_to_all_blocks_but_one(record, effects):
    catalogue = [CATALOGUE[name] for name in effects]
    reported = gap_of(fit_model([record], PRIOR, catalogue))
    fits = [fit_model([without(record, block)], PRIOR, catalogue) for block in range(BLOCKS)]
    rows = [fit.checked_rows for fit in fits]
    assert reported.rows == sum(rows)
    expected = sum(fit.held_out_chi2 * n for fit, n in zip(fits, rows, strict=True)) / sum(rows)
    assert reported.value == pytest.approx(expected, abs=2e-3)
    assert abs(reported.value - 1.0) < 4.0 * math.sqrt(2.0 / reported.rows) or not effects


def test_a_score_does_not_depend_on_which_blocks_the_model_was_fitted_to(record):
    scores = [fit_model([without(record, block)], PRIOR, ()).score for block in range(3)]
    assert np.ptp(scores) < 2.0


def test_the_noise_is_that_of_the_recording_whatever_the_configuration_says(record):
    """Gaps by a configuration with half and twice the noise are those by the right one."""
    found = [gap_of(fit_model([record_with((), noise)], PRIOR, ())).value for noise in ([], HALF, TWICE)]
    assert found[1] > 1.1
    assert found[2] < 0.9
    for noise in ([], HALF, TWICE):
        records = [record_with((), noise)]
        for _ in range(2):
            records = with_noise_floor(records, PRIOR, fit_model(records, PRIOR, ()))
        gap = gap_of(fit_model(records, PRIOR, ()))
        assert abs(gap.value - 1.0) < 4.0 * math.sqrt(2.0 / gap.rows)
