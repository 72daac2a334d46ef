"""All effects alike: their names, their neutral values, finite and continuous over their ranges."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active, Effect, Surroundings, forces_with, wheel_with
from soilbus.terra.effects.sensors import read_late
from soilbus.terra.wheel import FORCES, WheelModel, WheelState, wheel_forces
from wheels_around import REAR, wheels_around

NAMES = [
    "slip_sinkage", "stress_peak_shift", "rut_recovery", "exponential_shear", "bulldozing", "lugs",
    "rate_stiffening", "multipass", "hardpan", "tyre_deflection", "drivetrain_loss", "grade", "draft_offset",
    "draft_gain", "rolling_radius", "torque_lag", "channel_lag", "inertia", "wheel_load_offset", "soil_drift",
]  # fmt: skip
MODELS = {law: WheelModel(law) for law in ("exponential", "rational")}
EFFECTS = pytest.mark.parametrize("effect", CATALOGUE.values(), ids=CATALOGUE)


def everything(effect: Effect, values: dict, state: WheelState, model: WheelModel, around: Surroundings) -> dict:
    """All that an effect acts on."""
    forces = forces_with([Active(effect, values)], state, model, around)
    torque, draft = forces[FORCES.index("torque")], np.ravel(around.draft)
    nothing = np.zeros(len(draft))
    out = dict(zip(FORCES, forces, strict=True))
    out["reading"] = effect.torque(torque, around, values) if effect.torque else torque
    out["draft"] = draft + (effect.draft(draft, around, values) if effect.draft else nothing)
    out["load cell"] = around.load + (effect.load(around, values) if effect.load else 0.0)
    for quantity, late in effect.late.items():
        out[f"late {quantity}"] = read_late(np.sin(around.t), np.ravel(around.t), values, late)
    out["resistance"] = effect.resistance(around, values) if effect.resistance else nothing
    return out


def test_names_are_those_of_the_design_in_its_order():
    assert list(CATALOGUE) == NAMES
    assert [effect.name for effect in CATALOGUE.values()] == NAMES


@EFFECTS
def test_parameters_are_in_their_ranges_and_words_are_there(effect):
    assert effect.parameters
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)
    for p in effect.parameters:
        assert p.low <= p.neutral <= p.high
        assert 0.0 < p.std < p.high - p.low
        assert all(p.low < start < p.high for start in p.starts)
        assert p.unit
    for words in (effect.physics, effect.source, effect.tells):
        assert len(words.split()) >= 4
    assert effect.physics.endswith(".")


@EFFECTS
def test_at_least_one_hook_acts(effect):
    """One standard deviation of the first parameter changes something."""
    state, around = wheels_around(seed=3)
    first = effect.parameters[0]
    low = first.neutral + min(first.std, first.high - first.neutral)
    before, after = (
        everything(effect, effect.neutral | change, state, MODELS["rational"], around)
        for change in ({}, {first.name: low})
    )
    assert any(np.max(np.abs(after[k] - before[k])) > 1e-3 * np.max(np.abs(after[k])) for k in before)


@EFFECTS
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_neutral_values_change_nothing(effect, model):
    state, around = wheels_around(seed=1)
    plain = wheel_forces(state, model)
    out = everything(effect, effect.neutral, state, model, around)
    for name, force in zip(FORCES, plain, strict=True):
        assert np.max(np.abs(out[name] - force)) <= 1e-12 * np.max(np.abs(force))
    assert np.array_equal(out["reading"], out["torque"])
    assert np.array_equal(out["draft"], around.draft[:, 0])
    assert np.array_equal(out["load cell"], around.load)
    assert np.array_equal(out["resistance"], np.zeros(len(around.draft)))


@st.composite
def effects_with_values(draw):
    effect = draw(st.sampled_from(list(CATALOGUE.values())))
    return effect, {p.name: draw(st.floats(p.low, p.high)) for p in effect.parameters}


@given(effects_with_values(), st.sampled_from(["dry_sand", "wet_clay", "heavy_clay_40", "snow_us"]), st.integers(0, 9))
def test_finite_over_all_of_the_ranges(case, soil, seed):
    effect, values = case
    state, around = wheels_around(soil, 6, seed)
    for name, value in everything(effect, values, state, MODELS["rational"], around).items():
        assert np.all(np.isfinite(value)), name


@given(effects_with_values(), st.sampled_from(["loam", "wet_clay"]), st.data())
def test_a_small_step_of_a_parameter_makes_a_small_change(case, soil, data):
    effect, values = case
    p = data.draw(st.sampled_from(effect.parameters))
    step = 1e-7 * (p.high - p.low)
    state, around = wheels_around(soil, 6, 5)
    near = min(values[p.name] + step, p.high) if values[p.name] + step <= p.high else values[p.name] - step
    here = everything(effect, values, state, MODELS["rational"], around)
    there = everything(effect, values | {p.name: near}, state, MODELS["rational"], around)
    for name, value in here.items():
        size = np.max(np.abs(value)) + np.max(np.abs(here["load"]))
        assert np.max(np.abs(there[name] - value)) < 1e-4 * size, name


@EFFECTS
def test_wheel_and_forces_work_in_every_shape(effect):
    """(N, W), (W, N) with columns for wheels, and (N,) of one wheel give the same numbers."""
    state, around = wheels_around(seed=2, size=5)
    state = WheelState(*(np.broadcast_to(a, state.slip.shape) for a in state))
    around = around._replace(**{
        name: np.broadcast_to(getattr(around, name), state.slip.shape)
        for name in ("t", "distance", "load", "ground_speed", "wheel_speed", "rear", "draft", "acceleration")
    })  # fmt: skip

    def through(pick):
        picked = (type(a)(*(pick(v) if np.ndim(v) else v for v in a)) for a in (state, around))
        changed, surroundings = picked
        values = effect.neutral | {p.name: p.neutral + 0.3 * min(p.std, p.high - p.neutral) for p in effect.parameters}
        return forces_with([Active(effect, values)], changed, MODELS["rational"], surroundings)

    whole = through(lambda a: a)
    assert through(lambda a: a.T).swapaxes(1, 2) == pytest.approx(whole, rel=1e-12, abs=1e-8)
    for wheel in range(len(REAR)):
        assert through(lambda a, wheel=wheel: a[:, wheel]) == pytest.approx(whole[:, :, wheel], rel=1e-12, abs=1e-8)


def test_effects_add_up_in_one_wheel():
    """Wheel hooks first, in order, then force hooks: here with the radius of both radius effects."""
    state, around = wheels_around(seed=4)
    worn, soft = CATALOGUE["rolling_radius"], CATALOGUE["tyre_deflection"]
    pair = [Active(soft, {"compliance": 3e-6}), Active(worn, {"front": -0.04, "rear": 0.02})]
    both, _ = wheel_with(pair, state, MODELS["rational"], around)
    first, _ = wheel_with(pair[:1], state, MODELS["rational"], around)
    assert both.radius == pytest.approx(first.radius * np.where(REAR, 1.02, 0.96), rel=1e-12)
    assert np.all(first.radius > state.radius)


STARTS = [(effect, p, value) for effect in CATALOGUE.values() for p in effect.parameters for value in p.starts]


@pytest.mark.parametrize(("effect", "parameter", "value"), STARTS, ids=[f"{e.name}.{p.name}" for e, p, _ in STARTS])
def test_a_further_start_changes_nothing_while_the_effect_is_absent(effect, parameter, value):
    """Else its score would foresee the mending of what the start itself has broken."""
    state, around = wheels_around("loam", seed=4)
    plain = wheel_forces(state, WheelModel())
    started = forces_with([Active(effect, effect.neutral | {parameter.name: value})], state, WheelModel(), around)
    np.testing.assert_allclose(started, plain, rtol=1e-12)
    if effect.draft is not None:
        draft = np.linspace(-500.0, 4000.0, len(around.t))
        assert not np.any(effect.draft(draft, around, effect.neutral | {parameter.name: value}))
    if effect.load is not None:
        assert not np.any(effect.load(around, effect.neutral | {parameter.name: value}))
