"""A zero that wanders does so otherwise in every recording; what stays of it is the zero at the end of the last."""

from records import recorded
from soilbus.can.channels import Column
from soilbus.diagnosis.fitted_model import fit_model
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.estimation.assembly import prior_of
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.effects.catalogue import CATALOGUE

DURATION = 40.0


def wandering(rate: float, seed: int):
    """A drive on loam during which the zero at the hitch wanders at a rate [N/s] to 300 N at its end."""

    def moved(recording):
        t, draft = recording.channels["draft"].t, recording.channels["draft"].value
        return {"draft": Column(t, draft + 300.0 + rate * (t - DURATION))}

    return recorded(excited("loam", DURATION), seed, edit=moved, options=DiagnosisOptions(instant=0.1))


def test_each_recording_has_a_wander_of_its_own():
    records = [wandering(6.0, 3), wandering(-6.0, 4)]
    found = fit_model(records, prior_of(reference_configuration()), [CATALOGUE["draft_offset"]])
    assert found.held_out_chi2 < 1.1
    first, second = (found.fits[i].mode.gains[found.checks[i].problem.n_sensors :] for i in range(2))
    drift = [f.parameter.name for f in found.free].index("drift")
    std = found.free[drift].std
    assert 4.0 < first[drift] * std < 10.0
    assert -10.0 < second[drift] * std < -4.0
    offset = found.parameters()["draft_offset"]["offset"]
    assert abs(offset.value - 300.0) < 3.0 * offset.std


def test_what_a_recording_has_of_its_own_says_nothing_of_another_one():
    """What is the vehicle's is better known by both."""
    prior, effects = prior_of(reference_configuration()), [CATALOGUE["draft_offset"]]
    second = wandering(3.0, 4)
    alone, up, down = (
        fit_model([*first, second], prior, effects) for first in ([], [wandering(8.0, 3)], [wandering(-6.0, 3)])
    )
    place = alone.checks[0].problem.n_sensors + [f.parameter.name for f in alone.free].index("drift")
    one, other = (found.fits[1].mode.gain(place) for found in (up, down))
    assert abs(one.value - other.value) < 0.3 * one.std
    assert up.fits[0].mode.gain(place).value - down.fits[0].mode.gain(place).value > 10.0 * one.std
    before, after = (found.parameters()["draft_offset"]["offset"].std for found in (alone, up))
    assert after < 0.9 * before
