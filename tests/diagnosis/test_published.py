"""What published single-wheel points show in any case."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from records import recorded
from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import Verdict, gap_limit
from soilbus.estimation.assembly import prior_of
from soilbus.offline.tables import candidates, recordings_of_tables
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

RIGS = Path(__file__).with_name("rigs")
LUG = 0.01
"""Height of the lugs [m] of the two rigs that had both wheels."""


def configuration(rig: str, wheel: str, errors: float = 1.0) -> Config:
    """A rig's configuration for the rows of one wheel."""
    config = load_config(RIGS / f"{rig}.toml")
    noise = config.noise.model_dump()
    changes = [f"noise.{name}.absolute={errors * noise[name]['absolute']}" for name in ("draft", "torque", "sinkage")]
    if rig != "rashid1":
        changes.append(f"table.where.grouser_height_m={LUG if wheel == 'lugged' else 0.0}")
    return load_config(RIGS / f"{rig}.toml", changes)


def diagnosed(rig: str, wheel: str, errors: float, points: Path, other_wheel: FittedModel | None = None) -> Diagnosis:
    """The diagnosis of one wheel's points; `other_wheel` is the model fitted to another wheel on the same soil."""
    config = configuration(rig, wheel, errors)
    records = records_of(config, points, other_wheel)
    return diagnose(records, prior_of(config), candidates(config, records))


def records_of(config: Config, points: Path, other_wheel: FittedModel | None = None) -> tuple[Record, ...]:
    """One wheel's points; `other_wheel` as of diagnosed()."""
    records = recordings_of_tables(config, [points]).records
    if other_wheel is None:
        return records
    return tuple(r.with_effects(other_wheel.effects, other_wheel.free, other_wheel.fits[-1].mode) for r in records)


class Beside(NamedTuple):
    """What one effect beside those known does for the other wheel: fall of the score, strain left of the soil."""

    fall: float
    strain: float


def lugs_beside_a_shifted_peak(errors: float, points: Path) -> dict[str, Beside]:
    """Ding's lugged wheel with soil and slip sinkage as the smooth one had them: what each name then adds.

    "nothing" is the known model by itself.
    """
    config = configuration("ding2011", "smooth", errors)
    smooth = fit_model(records_of(config, points), prior_of(config), [CATALOGUE["slip_sinkage"]])
    config = configuration("ding2011", "lugged", errors)
    records, prior = records_of(config, points, smooth), prior_of(config)
    fits = {
        name: fit_model(records, prior, [*smooth.effects, *(CATALOGUE[n] for n in added)])
        for name, *added in (("nothing",), ("lugs", "lugs"), ("stress_peak_shift", "stress_peak_shift"))
    }
    known = fits["nothing"]
    return {n: Beside(known.score - fit.score, strain(fit)) for n, fit in fits.items() if fit is not None}


def strain(fitted: FittedModel) -> float:
    """Distance of the soil's posterior mean from its prior mean, as chi-square per parameter."""
    before, after = fitted.priors[-1], fitted.fits[-1].mode
    free = np.flatnonzero(np.diag(before.covariance)[:6] > 0.0)
    off = np.log(after.soil[free] / before.soil[free])
    return float(off @ np.linalg.solve(before.covariance[np.ix_(free, free)], off)) / len(free)


TESTED_PHI = math.radians(31.9)
"""Friction angle of the soil of Ding et al. 2011, from their shear tests."""


@pytest.fixture(scope="module")
def points(field_recording):
    return field_recording("single-wheel-published.csv")


@pytest.fixture(scope="module")
def ding(points):
    return {
        (wheel, errors): diagnosed("ding2011", wheel, errors, points)
        for wheel, errors in (("smooth", 1), ("smooth", 2), ("lugged", 1))
    }


@pytest.mark.parametrize(("wheel", "errors"), [("smooth", 1), ("smooth", 2), ("lugged", 1)])
def test_both_wheels_of_ding_dig_in_as_they_slip(ding, wheel, errors):
    """Their own finding, from which n = n0 + n1 s comes, outlives errors twice as large as assumed."""
    found = ding[wheel, errors]
    first = found.additions[0]
    assert first.effect.name == "slip_sinkage"
    assert first.probability > 0.8
    assert found.completed.held_out_chi2 - 1.0 < 0.5 * (found.base.held_out_chi2 - 1.0)
    assert found.completed.parameters()["slip_sinkage"]["exponent"].value == pytest.approx(0.7, abs=0.3)


def test_only_the_lugged_wheel_finds_the_friction_of_the_soil_itself(ding):
    """The prior holds both to 31.9 deg with 3 deg; the smooth rim slides before the soil shears."""
    reported = {
        wheel: ding[wheel, 1].completed.fits[-1].posterior.parameters()["phi"] for wheel in ("smooth", "lugged")
    }
    assert abs(reported["lugged"].value - TESTED_PHI) < 2.0 * reported["lugged"].std
    assert reported["smooth"].value + 3.0 * reported["smooth"].std < TESTED_PHI


@pytest.mark.parametrize("errors", [1, 2])
def test_the_smooth_wheels_soil_is_strained_by_the_lugged_wheel(points, ding, errors):
    """Something differs between them beside what both share; six points each do not show what for sure."""
    config = configuration("ding2011", "lugged", errors)
    records = records_of(config, points, ding["smooth", errors].completed)
    shown = fit_model(records, prior_of(config), records[0].training.effects)
    assert shown.names == ("slip_sinkage",)
    assert strain(shown) > 1.5
    again = records_of(configuration("ding2011", "smooth", errors), points, ding["smooth", errors].completed)
    assert strain(fit_model(again, prior_of(config), again[0].training.effects)) < 0.5  # its own points do not


@pytest.mark.parametrize("errors", [2.0, 3.0])
def test_lugs_and_another_shape_of_the_stress_predict_the_lugged_wheel_alike_but_only_lugs_leave_its_soil(
    points, errors
):
    """With errors that Ding's smooth wheel itself asks for no row tells them apart.

    Lugs alone leave the soil nearer to what the smooth wheel had.
    """
    beside = lugs_beside_a_shifted_peak(errors, points)
    lugs, shifted, nothing = (beside[name] for name in ("lugs", "stress_peak_shift", "nothing"))
    assert abs(lugs.fall - shifted.fall) < 12.0
    assert lugs.strain < 0.5 * nothing.strain
    assert shifted.strain > 0.8 * nothing.strain


def test_points_without_torque_are_diagnosed(points):
    found = diagnosed("rashid1", "lugged", 2, points)
    assert found.base.rows == 10  # five pulls and five sinkages
    assert found.base.held_out_chi2 > gap_limit(found.base.checked_rows)
    assert found.verdict is not Verdict.NONE


def test_the_papers_shear_law_against_exponential_soil_is_named():
    """Xi et al. 2024 take tau = (c + sigma tan phi) j / (j + K); the simulated soil follows Janosi and Hanamoto."""
    config = reference_configuration(['model.shear_law="rational"'])
    record = recorded(excited("dry_sand", 60.0), 3, config=config, truth=reference_configuration())
    found = diagnose([record], prior_of(config), list(CATALOGUE.values()))
    assert found.verdict is Verdict.NAMED
    assert [addition.effect.name for addition in found.additions] == ["exponential_shear"]
    share = found.completed.parameters()["exponential_shear"]["share"]
    assert abs(share.value - 1.0) < 3.0 * share.std
    assert share.std < 0.2
