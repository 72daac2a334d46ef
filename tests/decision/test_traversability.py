"""The decision: probability against Monte Carlo, and go only when everything speaks for it."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from soilbus.config.model import Traversability as Settings
from soilbus.decision.balance import Duty, Limits, balance, largest_pull
from soilbus.decision.capability import Demand, slip_grid
from soilbus.decision.judgement import judge
from soilbus.decision.traversability import State, Status
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.decision.wheels import wheel_table
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.posterior import Posterior
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import FAST_NODES, Soil, WheelModel
from statics import WEIGHT, brute

RIG = rig_of(reference_configuration())
MODEL = WheelModel(nodes=FAST_NODES)
DEFAULTS = Settings()
STRONG = np.full(4, 3000.0)


def posterior_of(soil: Soil, size: float = 0.05, seed: int = 0) -> Posterior:
    root = np.random.default_rng(seed).normal(0.0, size / math.sqrt(6.0), (6, 6))
    return Posterior(soil, root @ root.T)


LOAM = posterior_of(SOILS["loam"])
EASY = Demand(2000.0, 20.0)


def decide(posterior=LOAM, status=Status.VALID, demand=EASY, limit=STRONG, config=DEFAULTS, rig=RIG):
    return judge(posterior, status, demand, rig, MODEL, limit, config)[0]


def test_an_easy_draft_on_loam_is_a_go():
    way = decide()
    assert way.state is State.GO
    assert way.probability > 0.999
    assert way.torque_available == 12_000.0
    assert 0.0 < way.torque_required < way.torque_available
    assert 0.05 < way.slip_needed < 0.3
    assert way.max_draft.value > 5000.0
    assert 0.15 < way.max_grade.value < 0.35


@pytest.mark.parametrize(
    ("name", "limit"), [("loam", np.nan), ("loam", 700.0), ("wet_clay", np.nan), ("clayey_soil_38", 700.0)]
)
def test_spread_of_the_capability_equals_monte_carlo(name, limit):
    posterior = posterior_of(SOILS[name], 0.03, 3)
    limit = np.full(4, limit)
    way = decide(posterior, limit=limit)
    logs = np.random.default_rng(1).multivariate_normal(np.log(posterior.soil), posterior.log_covariance, 2000)
    table = wheel_table(np.exp(logs), RIG, MODEL, slip_grid(DEFAULTS.max_slip))
    limits = Limits.of(table.axles, limit, DEFAULTS.max_sinkage, UncertainModel.over(MODEL), len(logs))
    drafts, pulls = (largest_pull(balance(table, duty), limits).pull for duty in (Duty(), Duty(0.0, None)))
    for estimate, sample in ((way.max_draft, drafts), (way.max_grade, np.arcsin(pulls / WEIGHT))):
        assert estimate.std == pytest.approx(np.std(sample), rel=0.1)  # sampling: 1.6 %
        assert estimate.value == pytest.approx(np.mean(sample), abs=0.1 * estimate.std)


@pytest.mark.parametrize("status", Status)
def test_probability_falls_with_demand_and_state_follows(status):
    ways = [decide(status=status, demand=Demand(pull, 50.0)) for pull in np.linspace(-2000.0, 9000.0, 23)]
    if status is Status.INVALID:
        assert all(w.state is State.UNKNOWN and w.probability is None for w in ways)
        return
    probability = [w.probability for w in ways]
    assert np.all(np.diff(probability) <= 0.0)
    assert probability[0] > 0.999
    assert probability[-1] < 0.001
    for way in ways:
        if way.probability < DEFAULTS.no_go:
            assert way.state is State.NO_GO
        elif way.probability >= DEFAULTS.go and status is Status.VALID:
            assert way.state is State.GO
        else:
            assert way.state is State.CAUTION


def test_probability_is_that_of_the_gaussian_margin():
    likely = decide(demand=Demand(0.0, 0.0)).capability.likely_pull
    for z in (-2.0, -0.5, 0.0, 1.0, 2.5):
        std = math.hypot(likely.std, 300.0)
        pull = (likely.value - z * std) / (1.0 + DEFAULTS.margin)
        expected = 0.5 * (1.0 + math.erf(z / math.sqrt(2.0)))
        assert decide(demand=Demand(pull, 300.0)).probability == pytest.approx(expected, abs=1e-6)


def test_the_margin_counts_for_pulling_only():
    careful = Settings(margin=0.5)
    assert (
        decide(demand=Demand(5000.0, 100.0), config=careful).probability
        < decide(demand=Demand(5000.0, 100.0)).probability
    )
    mud = SOILS["wet_clay"]._replace(c=0.2 * SOILS["wet_clay"].c, phi=0.2 * SOILS["wet_clay"].phi)  # must be pushed
    needs = decide(posterior=posterior_of(mud), demand=Demand(0.0, 0.0)).capability.likely_pull
    assert needs.value < -1000.0
    for margin in (0.0, 0.15, 0.5):
        way = decide(posterior=posterior_of(mud), demand=Demand(needs.value, 100.0), config=Settings(margin=margin))
        assert way.probability == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(
    ("deepest", "state"),
    [(0.045, State.NO_GO), (0.05, State.CAUTION), (0.055, State.CAUTION), (0.06, State.GO)],
)
def test_ground_that_holds_the_pull_but_not_the_depth_is_no_go(deepest, state):
    """Loam takes four times the draft, but the wheels go 4.6 +- 0.6 cm deep."""
    way = decide(config=Settings(max_sinkage=deepest), demand=Demand(1500.0, 20.0))
    depth = way.capability.forecast.likely_depth
    assert way.capability.likely_pull.value > 4.0 * 1500.0
    assert way.probability == pytest.approx(norm.sf(depth.value, deepest, depth.std), abs=1e-6)
    assert (way.state, way.limit) == (state, "sinkage")


def test_weak_motors_limit():
    weak = decide(limit=np.full(4, 500.0))
    assert weak.limit == "torque"
    assert weak.max_draft.value < decide().max_draft.value
    assert decide().limit in ("slip", "traction")
    assert decide(limit=np.full(4, 500.0), demand=Demand(4000.0, 50.0)).state is State.NO_GO
    for pull in (0.0, -1000.0):  # without torque the soil holds the tractor, also on a gentle slope down
        none = decide(limit=np.zeros(4), demand=Demand(pull, 100.0))
        assert none.state is State.NO_GO
        assert none.torque_available == 0.0
    unknown = decide(limit=np.array([500.0, np.nan, 500.0, 500.0]))
    assert unknown.torque_available is None
    assert unknown.limit == "torque"


@pytest.mark.parametrize("status", Status)
def test_nothing_is_known_without_a_posterior(status):
    way = decide(posterior=None, status=status)
    assert way.state is State.UNKNOWN
    assert (way.probability, way.max_draft, way.max_grade, way.slip_needed) == (None,) * 4
    assert way.torque_available == 12_000.0


@pytest.mark.parametrize("status", Status)
def test_nothing_is_decided_without_a_demand_or_a_vehicle(status):
    way = decide(status=status, demand=None)
    assert way.state is State.UNKNOWN
    assert way.probability is None
    assert (way.max_draft is None) == (status is Status.INVALID)
    assert decide(status=status, rig=dataclasses.replace(RIG, chassis=None)).state is State.UNKNOWN


def test_no_go_where_nothing_balances():
    slush = posterior_of(SOILS["heavy_clay_40"]._replace(k_c=10.0, k_phi=500.0, c=50.0, phi=0.02))
    way, curve = judge(slush, Status.VALID, Demand(0.0, 1.0), RIG, MODEL, STRONG, DEFAULTS)
    assert (way.state, way.probability, way.limit) == (State.NO_GO, 0.0, "sinkage")
    assert curve is None


def test_a_demand_that_no_slip_gives_has_no_slip():
    way = decide(demand=Demand(20_000.0, 10.0))
    assert way.state is State.NO_GO
    assert way.slip_needed is None
    assert way.torque_required is None


def test_a_warm_start_decides_the_same():
    for name in ("loam", "wet_clay", "clayey_soil_38"):
        posterior = posterior_of(SOILS[name])
        cold, curve = judge(posterior, Status.VALID, Demand(1500.0, 50.0), RIG, MODEL, STRONG, DEFAULTS)
        near = posterior_of(posterior.soil._replace(k_phi=1.1 * posterior.soil.k_phi))
        _, other = judge(near, Status.VALID, Demand(1500.0, 50.0), RIG, MODEL, STRONG, DEFAULTS)
        for start in (curve, other):
            warm, _ = judge(posterior, Status.VALID, Demand(1500.0, 50.0), RIG, MODEL, STRONG, DEFAULTS, start)
            assert warm.state is cold.state
            assert warm.probability == pytest.approx(cold.probability, abs=1e-3)
            assert warm.max_draft.value == pytest.approx(cold.max_draft.value, rel=1e-4)
            assert warm.max_draft.std == pytest.approx(cold.max_draft.std, rel=1e-2)


TORQUES = st.lists(
    st.one_of(st.floats(0.0, 5e3), st.sampled_from([math.nan, math.inf, 0.0])), min_size=4, max_size=4
).map(np.array)


@given(
    soil=st.sampled_from(list(SOILS.values())),
    size=st.floats(0.0, 1.0),
    status=st.sampled_from(Status),
    demand=st.none() | st.builds(Demand, st.floats(-3e3, 2e4), st.floats(0.0, 5e3)),
    limit=TORQUES,
    go=st.floats(0.6, 0.99),
    margin=st.floats(0.0, 1.0),
)
def test_go_only_when_everything_speaks_for_it(soil, size, status, demand, limit, go, margin):
    config = Settings(go=go, no_go=0.5, margin=margin)
    way = decide(posterior_of(soil, size), status, demand, limit, config)
    if way.state is State.GO:
        assert status is Status.VALID
        assert demand is not None
        assert way.probability >= go
        # Even one sigma of demand and capability apart from the best estimate, and with the margin.
        assert way.max_draft.value >= demand.pull + margin * max(demand.pull, 0.0)
        assert way.slip_needed is not None or demand.pull <= 0.0
    for value in (way.probability, way.torque_required, way.torque_available, way.slip_needed):
        assert value is None or not math.isnan(value)
    for estimate in (way.max_draft, way.max_grade):
        assert estimate is None or (math.isfinite(estimate.value) and math.isfinite(estimate.std))
    assert way.probability is None or 0.0 <= way.probability <= 1.0
    assert (way.state is State.UNKNOWN) == (way.probability is None)


def test_a_torque_limit_at_the_least_slip_is_a_limit_like_any_other():
    """About half of the posterior's soils turn the wheels at the least slip, the rest only where they skid."""
    posterior = Posterior(SOILS["sandy_loam_22"], np.diag([0.01, 0.0004, 0.0004, 0.0004, 0.01, 0.01]))
    deep = DEFAULTS.model_copy(update={"max_sinkage": 0.4})
    needed = brute(SOILS["sandy_loam_22"], 0.02)[1][2].max()
    above, below = (
        decide(posterior=posterior, limit=np.full(4, share * needed), demand=Demand(0.0, 20.0), config=deep)
        for share in (1.01, 0.99)
    )
    assert above.limit == below.limit == "torque"
    assert above.max_draft.value > below.max_draft.value
    assert above.max_draft.std == pytest.approx(below.max_draft.std, rel=0.3)
    assert min(above.probability, below.probability) > 0.99  # of no pull at all
