"""The eliminated latents against explicit minimisation, and the residuals' covariance against Monte Carlo."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from soilbus.can.channels import Column
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.instants import averaged
from soilbus.estimation.linearisation import Latents
from soilbus.estimation.measurements import differentiated_speed
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel, inverse_covariance
from soilbus.estimation.standing import STANDING, standing_std, wheel_inertia
from soilbus.estimation.window import Rig, Window, window_of_samples
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import Soil, WheelModel, sinkage, state_on, wheel_forces
from soilbus.trials.windows import observed
from tests.lab import computed_loads

MODEL = WheelModel()
PARAMETERS = Soil._fields


def explicit(rig: Rig, soil: Soil, load, speed, ground_speed):
    """Pull (summed), torques and sinkages of one instant or of N (last axis the wheels)."""
    slip = 1.0 - np.asarray(ground_speed)[..., None] / (rig.radius * speed)
    state = state_on(soil, np.full(np.shape(load), 0.2), slip, rig.radius, rig.width)
    angle = entry_angle_for_load(load, state, MODEL)
    _, pull, torque = wheel_forces(state._replace(entry_angle=angle), MODEL)
    return pull.sum(-1), torque, sinkage(angle, rig.radius)


def cost_of_instant(window: Window, rig: Rig, i: int, soil: Soil, gains: dict[str, float]) -> float:
    """Least sum of squares over loads, speeds and ground speed, by scipy: reading = truth (1 + gain) + noise."""
    W = len(rig.wheels)
    gain = {q: np.array([gains.get(f"{q}.{w}", 0.0) for w in rig.wheels]) for q in ("torque", "load", "speed")}
    gain |= {q: gains.get(q, 0.0) for q in ("ground_speed", "draft")}
    sd = {q: np.sqrt(v[i]) for q, v in window.variance.items()}
    sd |= {q: sd[q] / (1.0 + g) for q, g in gain.items()}  # of the reading, scaled back to the truth

    def corrected(quantity: str) -> np.ndarray:
        value, name = getattr(window, quantity), f"lateness.{quantity}"
        late = gains[name] * slope_of(value) if name in gains else 0.0
        return value[i] / (1.0 + gain[quantity]) + late

    def slope_of(values: np.ndarray) -> np.ndarray:
        return np.gradient(values, window.t, axis=0)[i]

    kinematic = 1.0 - window.ground_speed[:, None] / (rig.radius * window.speed)
    rim, accelerates = rig.radius * window.speed[i], slope_of(window.ground_speed)
    slip_rate = (window.ground_speed[i] * slope_of(window.speed) / window.speed[i] - accelerates) / rim
    relaxed = kinematic[i] - gains.get("relaxation_length", 0.0) / window.ground_speed[i] * slip_rate
    by_slip = rig.radius * window.speed[i] ** 2 / window.ground_speed[i]
    seen = np.concatenate([corrected("load"), corrected("speed") + by_slip * (relaxed - kinematic[i])])
    ground = corrected("ground_speed")
    speeding_up = gains.get("wheel_inertia", 0.0) * wheel_inertia(rig) * slope_of(window.speed)
    torque_read = corrected("torque") - speeding_up
    chassis = rig.chassis
    slope = GRAVITY * np.sin(window.pitch[i]) + window.acceleration[i]
    slope += gains.get("lateness.acceleration", 0.0) * slope_of(window.acceleration)
    demand = corrected("draft") + chassis.mass * slope
    slope_sd = np.hypot(GRAVITY * np.cos(window.pitch[i]) * sd["pitch"], sd["acceleration"])
    demand_sd = np.hypot(sd["draft"], chassis.mass * slope_sd)
    size = np.concatenate([sd["load"], sd["speed"], [sd["ground_speed"]]])
    start = np.concatenate([seen, [ground]])

    def residuals(x: np.ndarray) -> np.ndarray:
        """Of latents (..., 2 W + 1) in their standard deviations."""
        latent = start + x * size
        pull, torque, z = explicit(rig, soil, latent[..., :W], latent[..., W : 2 * W], latent[..., 2 * W])
        rows = [x, (torque_read - torque) / sd["torque"], ((demand - pull) / demand_sd)[..., None]]
        parts = np.concatenate([*rows, (window.sinkage[i] - z) / sd["sinkage"]], axis=-1)
        return parts[..., known]

    def jacobian(x: np.ndarray) -> np.ndarray:
        h = 1e-4 * np.eye(len(x))
        return (residuals(x + h) - residuals(x - h)).T / 2e-4

    known: slice | np.ndarray = slice(None)
    known = np.isfinite(residuals(np.zeros(2 * W + 1)))
    return 2.0 * least_squares(residuals, np.zeros(2 * W + 1), jacobian, xtol=1e-10, ftol=1e-13, gtol=1e-9).cost


def converged(problem: ObservationModel, soil: Soil, gains: np.ndarray):
    """The linearisation at the best latents for a held soil and gains."""
    latents = problem.start(soil)
    none = np.zeros(6), np.zeros(len(gains))
    for _ in range(8):
        at = problem.linearise(soil, gains, latents)
        latents = problem.updated(at, latents, *none)
    return problem.linearise(soil, gains, latents)


@pytest.fixture(scope="module")
def few(simulated):
    """A handful of instants, one without a torque, one without sinkages; a wrong soil and gains."""
    case = simulated(SOILS["clayey_soil_38"], 11)
    window = case.window.rows(np.array([2, 30, 55, 80]))
    window.torque[1, 0] = np.nan
    window.sinkage[2] = np.nan
    rng = np.random.default_rng(3)
    problem = ObservationModel(window, case.rig, MODEL, 0.2)
    soil = Soil(*(np.asarray(case.soil) * np.exp(rng.normal(0.0, 0.03, 6))))
    gains = problem.gain_std * rng.standard_normal(len(problem.gain_std))
    gains[-len(STANDING) :] *= 0.1  # slopes between instants seconds apart are no motion of wheels
    return window, case.rig, problem, soil, gains


def total_cost(few, soil, gains) -> float:
    window, rig, problem, _, _ = few
    named = dict(zip(problem.gain_names, gains, strict=True))
    return sum(cost_of_instant(window, rig, i, soil, named) for i in range(len(window.t)))


def test_chi_square_is_the_least_sum_of_squares_over_the_latents(few):
    _, _, problem, soil, gains = few
    assert converged(problem, soil, gains).chi2 == pytest.approx(total_cost(few, soil, gains), rel=1e-6)
    assert problem.n_rows == 4 * 9 - 1 - 4


def test_gradients_are_those_of_the_least_sum_of_squares(few):
    # By the envelope theorem the derivative of the least cost is 2 J' S^-1 r at the best latents.
    _, _, problem, soil, gains = few
    sensors = problem.layout.standing.start
    gains = np.where(np.arange(len(gains)) < sensors, gains, 0.0)
    at = converged(problem, soil, gains)
    gradient = 2.0 * at.weighed.T @ at.rows[:, 0]
    assert gradient[0] == pytest.approx(2.0 * at.chi2)
    for k, name in enumerate(PARAMETERS):
        h = 2e-4 * soil[k]
        up, down = (total_cost(few, soil._replace(**{name: soil[k] + s * h}), gains) for s in (1, -1))
        assert gradient[1 + k] * soil[k] == pytest.approx((up - down) / (2 * h) * soil[k], rel=1e-4, abs=1e-4), name
    drawn = np.random.default_rng(1).standard_normal((2, sensors))
    for way in np.pad(drawn, ((0, 0), (0, len(gains) - sensors))) * problem.gain_std:
        numeric = (total_cost(few, soil, gains + 0.05 * way) - total_cost(few, soil, gains - 0.05 * way)) / 0.1
        assert gradient[7:] @ way == pytest.approx(numeric, rel=2e-3)


def test_covariance_of_residuals_equals_monte_carlo(simulated):
    # One true state, seen 4000 times through the sensors' noise.
    case = simulated(SOILS["loam"], 5)
    rig, soil, n = case.rig, case.soil, 4000
    load, speed = np.array([5200.0, 4800.0, 6000.0, 5500.0]), np.array([4.0, 4.1, 3.2, 3.25])
    pull, torque, z = explicit(rig, soil, load, speed, np.float64(1.5))
    rng = np.random.default_rng(4)
    truth = {"torque": torque, "load": load, "speed": speed, "sinkage": z}
    columns = {f"{q}.{w}": v[i] for q, v in truth.items() for i, w in enumerate(rig.wheels)}
    columns |= {"ground_speed": 1.5, "pitch": 0.03, "acceleration": 0.1}
    columns["draft"] = pull - rig.chassis.mass * (GRAVITY * np.sin(0.03) + 0.1)
    noisy = {}
    for name, value in columns.items():
        noise = rig.noise[name.partition(".")[0]]
        sd = np.sqrt(noise.absolute**2 + ((noise.relative**2 + noise.of_mean**2) * value**2))
        noisy[name] = value + sd * rng.standard_normal(n)
    problem = ObservationModel(window_of_samples(rig, np.arange(n, dtype=float), noisy), rig, MODEL, 0.2)
    none = np.zeros(len(problem.gain_std))
    latents = Latents(
        *(np.broadcast_to(a, (n, *np.shape(a))).copy() for a in (load, speed)), np.full(n, 1.5), np.full((n, 4), np.nan)
    )
    at = problem.linearise(soil, none, problem.with_entry_angles(latents, soil))
    rows, weighed = (a.reshape(n, 9, -1) for a in (at.rows, at.weighed))
    # Residuals by hand, with the measured loads and speeds, not linearised at all.
    got = [np.stack([noisy[f"{q}.{w}"] for w in rig.wheels], axis=1) for q in ("load", "speed", "torque", "sinkage")]
    pull, torque, z = explicit(rig, soil, got[0], got[1], noisy["ground_speed"])
    slope = GRAVITY * np.sin(noisy["pitch"]) + noisy["acceleration"]
    by_hand = np.column_stack([got[2] - torque, noisy["draft"] + rig.chassis.mass * slope - pull, got[3] - z])
    inverse = weighed[0] @ np.linalg.pinv(rows[0])  # S^-1 of one instant
    assert inverse == pytest.approx(inverse.T, rel=1e-6, abs=1e-9 * np.abs(inverse).max())
    half = np.linalg.cholesky((inverse + inverse.T) / 2.0)
    for residuals in (rows[:, :, 0], by_hand):
        white = residuals @ half
        assert np.cov(white.T) == pytest.approx(np.eye(9), abs=0.1)  # sampling sd 0.016 (0.022 on the diagonal)
    assert at.chi2 / problem.n_rows == pytest.approx(1.0, abs=0.03)


def test_masks(simulated):
    case = simulated(SOILS["loam"], 5)
    window = case.window
    window = window.rows(np.arange(len(window.t)))
    window.ground_speed[:10] = 0.05  # standing
    window.ground_speed[10:15] = np.nan
    window.speed[20:25, 0] = -1.0  # a wheel turning backwards
    window.load[30:33, 1] = 0.0  # in the air
    window.load[40, 2] = np.nan
    window.draft[50:60] = np.nan
    problem = case.problem(window)
    assert problem.standstill == 10
    assert problem.n == 85
    usable = problem.usable
    assert (~usable).sum(axis=0).tolist() == [5, 3, 1, 0]
    assert problem.has_balance.sum() == 85 - 5 - 3 - 1 - 10
    assert problem.n_rows == problem.has_balance.sum() + 2 * (4 * 85 - 9)
    assert np.isfinite(problem.linearise(case.soil, np.zeros(len(problem.gain_std)), problem.start(case.soil)).chi2)


def test_acceleration_from_speed_and_its_variance():
    t = np.arange(0.0, 10.0, 0.1)
    a, variance = differentiated_speed(t, 1.0 + 0.3 * t, np.full(100, 1e-4))
    assert a == pytest.approx(np.full(100, 0.3), abs=1e-9)
    # Slope of a cubic by least squares through 29 samples: s_6 / (s_2 s_6 - s_4^2), s_k the sum of k-th powers.
    s2, s4, s6 = (float((np.arange(-14.0, 15.0) ** k).sum()) for k in (2, 4, 6))
    assert variance[50] == pytest.approx(1e-4 / 0.01 * s6 / (s2 * s6 - s4**2), rel=1e-9)
    assert variance[0] > 10.0 * variance[50]
    # A jerk is not a precise acceleration.
    step = np.where(t < 5.0, 1.0, 2.0)
    assert differentiated_speed(t, step, np.full(100, 1e-4))[1][50] > 10.0 * variance[50]
    assert (differentiated_speed(t[:2], step[:2], np.full(2, 1e-4))[1] >= 1.0).all()


@pytest.mark.parametrize(("swing", "rate"), [(0.3, 0.5), (0.8, 2.0)], ids=["easy", "harsh"])
def test_the_variance_of_acceleration_from_speed_is_that_of_its_errors(swing, rate):
    t, rng = np.delete(np.arange(0.0, 10.0, 0.1), [40, 41, 42]), np.random.default_rng(0)
    true = swing * rate * np.cos(rate * t)
    speed = 1.0 + swing * np.sin(rate * t) + 0.01 * rng.standard_normal((400, len(t)))
    found, variance = np.swapaxes([differentiated_speed(t, row, np.full(len(t), 1e-4)) for row in speed], 0, 1)
    z = (found - true) / np.sqrt(variance)
    assert np.sqrt((z**2).mean()) == pytest.approx(1.0, abs=0.1)
    assert np.abs(z.mean(axis=0)).max() < 0.5


def test_rows_that_one_latent_swamps_have_a_finite_inverse():
    """As at a trial point of the search on a rover's window: derivatives by speeds of 1e15, five rows alike."""
    A = np.zeros((1, 5, 9))
    A[0, :, 8] = [3.4e15, 3.3e15, 3.8e15, 2.8e15, 5.1e16]
    inverse = inverse_covariance(A, np.full((1, 9), 0.05**2), np.full((1, 5), 25.0))
    assert np.isfinite(inverse).all()
    assert (np.linalg.eigvalsh(inverse[0]) > -1e-20).all()


@pytest.mark.parametrize("seed", [390794349, 1373557564, 2444203465, 3971769130])
def test_a_fit_behind_an_open_differential_converges_where_loads_shake(seed):
    # Side loads follow from equal torques.  Where their noise is not in the weights and they are not in the Jacobian,
    # -2 log posterior rises along the step and the descent ends at its limit.
    task = computed_loads.Task("tractor-2wd", "loam", 0.12, seed)
    problem, prior = computed_loads.window_of(task)
    fit = fit_window(problem, prior)
    assert fit.converged
    pressure, true = fit.mode.posterior.bearing_pressure(0.1, 0.3), SOILS["loam"].bearing_pressure(0.1, 0.3)
    assert abs(np.log(pressure.value / true)) < 2.5 * pressure.std / pressure.value


def test_a_mean_over_swinging_slips_is_one_of_the_forces() -> None:
    rig, soil = rig_of(reference_configuration()), SOILS["loam"]
    t = np.arange(0.05, 10.0, 0.1)
    load, ground = np.tile([5e3, 5e3, 6e3, 6e3], (len(t), 1)), np.full(len(t), 1.2)
    slip = 0.2 + np.outer(np.sin(2.0 * np.pi * 2.0 * t), [0.02, 0.05, 0.1, 0.1])
    speed = ground[:, None] / (rig.radius * (1.0 - slip))
    pull, torque, _ = explicit(rig, soil, load, speed, ground)
    samples = {"ground_speed": ground, "draft": pull, "pitch": 0.0 * t, "acceleration": 0.0 * t}
    for quantity, values in (("load", load), ("speed", speed), ("torque", torque)):
        samples |= {f"{quantity}.{wheel}": values[:, i] for i, wheel in enumerate(rig.wheels)}
    window = averaged(window_of_samples(rig, t, samples), 10.0, 0.5)

    def off(window: Window) -> np.ndarray:
        problem = ObservationModel(window, rig, MODEL, 0.1)
        at = problem.linearise(soil, np.zeros(len(problem.gain_names)), problem.start(soil))
        return np.abs(at.rows[:, 0].reshape(problem.n, -1).mean(axis=0))[[2, 3, 4]]  # torques behind, balance

    assert (off(window) < 0.25 * off(replace(window, swing=0.0 * window.swing))).all()


# --- relaxation, wheel inertia and late channels: drives that have them give them back ---

CONFIG = reference_configuration()
RIG = rig_of(CONFIG)
LIVELY = Scenario(
    12.0, (Patch(0.0, "loam"),), Swing(1.0, 2.0, 0.1, 0.5), slip=Swing(0.05, 0.4, 0.1, 0.5), side_shift=Swing(-0.2, 0.2)
)
"""A drive whose slips, speeds and loads move within a second."""


def test_derivatives_are_finite_differences_of_the_residuals(simulated):
    case = simulated(SOILS["loam"], 3)
    problem = case.problem()
    latents, first = problem.start(case.soil), problem.gain_names.index(STANDING[0])
    gains = problem.gain_std * np.random.default_rng(1).standard_normal(len(problem.gain_std))
    column = problem.layout.sensor_columns.start + first
    for i, name in enumerate(STANDING):
        step = 1e-3 * problem.gain_std[first + i] * (np.arange(len(gains)) == first + i)
        up, down = (problem.linearise(case.soil, gains + way * step, latents).rows[:, 0] for way in (1.0, -1.0))
        ours = problem.linearise(case.soil, gains, latents).rows[:, column + i]
        expected = (up - down) / (2.0 * step.max())
        assert np.abs(expected).max() > 0.0, name
        assert ours == pytest.approx(expected, abs=1e-5 * np.abs(expected).max()), name


def late(channel: str, by: float) -> Callable[[Recording], dict[str, Column]]:
    """Samples of a quantity, stamped later by some seconds."""

    def of(recording: Recording) -> dict[str, Column]:
        return {
            name: Column(c.t + by, c.value) if name.partition(".")[0] == channel else c
            for name, c in recording.channels.items()
        }

    return of


def relaxed(length: float) -> Callable[[Recording], dict[str, Column]]:
    """Wheels that turn so that their kinematic slip is s + (L / V) ds/dt; torque and pull are those of s."""

    def of(recording: Recording) -> dict[str, Column]:
        truth, channels = recording.truth, dict(recording.channels)
        for name, radius in zip(RIG.wheels, RIG.radius, strict=True):
            speed = channels[f"speed.{name}"]
            slip = 1.0 - truth["ground_speed"] / (radius * truth[f"speed.{name}"])
            lag = length / truth["ground_speed"] * np.gradient(slip, truth["t"])
            factor = np.interp(speed.t, truth["t"], (1.0 - slip) / (1.0 - slip - lag))
            channels[f"speed.{name}"] = Column(speed.t, speed.value * factor)
        return channels

    return of


def with_inertia(discs: float) -> Callable[[Recording], dict[str, Column]]:
    """Torques that also speed the wheels up."""

    def of(recording: Recording) -> dict[str, Column]:
        truth, channels = recording.truth, dict(recording.channels)
        for name, inertia in zip(RIG.wheels, discs * wheel_inertia(RIG), strict=True):
            torque, rate = channels[f"torque.{name}"], np.gradient(truth[f"speed.{name}"], truth["t"])
            channels[f"torque.{name}"] = Column(
                torque.t, torque.value + inertia * np.interp(torque.t, truth["t"], rate)
            )
        return channels

    return of


MACHINES = {
    "relaxation_length": (relaxed(0.15), 0.15), "wheel_inertia": (with_inertia(12.0), 12.0),
    "lateness.load": (late("load", 0.05), 0.05), "lateness.ground_speed": (late("ground_speed", 0.12), 0.12),
    "lateness.draft": (late("draft", 0.06), 0.06), "lateness.acceleration": (late("acceleration", 0.05), 0.05),
}  # fmt: skip


@pytest.mark.parametrize("name", STANDING)
def test_a_drive_gives_its_own_value_back(name):
    change, true = MACHINES[name]
    problem = observed(CONFIG, change(simulate(CONFIG, LIVELY, 5)), 10.0)
    fit = fit_window(problem, prior_of(CONFIG))
    found, std = (of[problem.gain_names.index(name)] for of in (fit.gains, problem.gain_std))
    assert found == pytest.approx(true, rel=0.3)  # slopes of what is measured have noise, which makes each less
    assert fit.mode.gain(problem.gain_names.index(name)).std < 0.2 * std


def test_a_test_rig_has_none():
    assert standing_std(replace(RIG, chassis=None)) == [0.0] * len(STANDING)
