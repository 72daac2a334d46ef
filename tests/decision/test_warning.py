"""The warning from what is measured alone, on machines as they are: each wheel with its own inertia, grip and rut.

J domega/dt = T - r F - r F_roll,    m dV/dt = sum F - R,    F = mu N (1.35 tanh 6 s - 0.35 tanh 1.2 s)
R grows with the distance that each wheel turns more than its ground goes by; on a curve each wheel has its own ground.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from soilbus.config.model import Config
from soilbus.decision.capability import Capability, Forecast, OverSlip
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.moments import common_slip, moment_of
from soilbus.decision.traversability import State, Traversability
from soilbus.decision.watch import Alert, Warnings, Watch, ended, watched
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Rig, SensorNoise, Window, forward, window_of_samples
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.vehicle import GRAVITY, Chassis
from watched_drives import look

WHEELS = ("FL", "FR", "RL", "RR")
SIDE = (-1.0, 1.0, -1.0, 1.0)
STEP, LOOK = 0.001, 0.1
NOISE = {
    "torque": SensorNoise(relative=0.02), "load": SensorNoise(absolute=50.0), "speed": SensorNoise(relative=0.01),
    "sinkage": SensorNoise(absolute=0.005), "draft": SensorNoise(absolute=50.0), "pitch": SensorNoise(absolute=0.01),
    "acceleration": SensorNoise(absolute=0.1), "yaw_rate": SensorNoise(absolute=0.01),
}  # fmt: skip


@dataclass(frozen=True)
class Machine:
    """A vehicle and its course; `soft` is the grip of each wheel from `softens` [s] on."""

    drive: str = "motors"  # one motor a wheel; "open", "rear": one an axle, or on the rear one, behind differentials
    mass: float = 90.0
    radius: float = 0.27
    track: float = 1.2
    speed: float = 1.4
    yaw: float = 0.0
    grip: float = 0.7
    soft: tuple[float, ...] = (0.45,) * 4
    softens: float = 12.0
    base: float = 0.12
    slope: float = 0.0
    digs: float = 0.3
    limit: float = 1.0
    gain: float = 6.0
    ramp: float = 3.0
    stops: float = math.inf
    jerks: bool = False
    noise: float = 0.02
    min_speed: float = 0.2
    known_limit: bool = False
    unknown: tuple[str, ...] = field(default=())

    @property
    def rig(self) -> Rig:
        """The vehicle as soilbus knows it."""
        chassis = Chassis(self.mass, 1.6, 0.8, 0.4, 0.3)
        driven = np.array([self.drive != "rear"] * 2 + [True] * 2)
        front = np.array([True, True, False, False])
        noise = NOISE | {"ground_speed": SensorNoise(absolute=self.noise, relative=0.01)}
        return Rig(
            WHEELS, np.full(4, self.radius), np.full(4, 0.3), front, chassis, noise, track=self.track, driven=driven
        )

    def torques(self, t: float, omega: list[float]) -> list[float]:
        """Torques of the wheels [N m] at wheel speeds [rad/s]: motors that hold a speed, up to their limit."""
        share = 0.0 if t > self.stops else min(t / self.ramp, 1.0)
        if self.jerks and t > 8.0:
            share *= 1.5 if int(t / 3.0) % 2 else 1.0
        wanted = 1.05 * self.speed * share / self.radius
        most = self.limit * self.mass * GRAVITY / 4.0 * self.radius

        def held(now: float, aim: float, cap: float) -> float:
            return min(max(self.gain * self.mass * (aim - now) * self.radius**2, -0.1 * cap), cap)

        if self.drive == "motors":
            turn = [1.0 + side * self.yaw * self.track / 2.0 / self.speed for side in SIDE]
            return [held(w, wanted * more, most) for w, more in zip(omega, turn, strict=True)]
        rear = held((omega[2] + omega[3]) / 2.0, wanted, 2.0 * most if self.drive == "rear" else most)
        front = 0.0 if self.drive == "rear" else held((omega[0] + omega[1]) / 2.0, wanted, most)
        return [front, front, rear, rear]

    def driven(self, seed: int, duration: float = 25.0) -> tuple[Window, float]:
        """What its sensors say ten times a second, and when it stood still after it had moved [s]."""
        rows, stood = replace(self, unknown=()).rows(seed, duration)
        t, speed, yaw, acceleration, *wheels = rows.T
        samples = {"ground_speed": speed, "yaw_rate": yaw, "acceleration": acceleration, "draft": np.zeros(len(t))}
        samples |= {"pitch": np.full(len(t), self.slope)}
        samples |= {f"speed.{w}": wheels[k] for k, w in enumerate(WHEELS)}
        samples |= {f"torque.{w}": wheels[4 + k] for k, w in enumerate(WHEELS)}
        return window_of_samples(self.rig, t, {n: v for n, v in samples.items() if n not in self.unknown}), stood

    @cache  # noqa: B019  # machines live as long as the module
    def rows(self, seed: int, duration: float) -> tuple[np.ndarray, float]:
        """The readings of all sensors, and when it stood still."""
        normal = np.random.default_rng(seed).standard_normal
        load, V, seen, stood, moved = self.mass * GRAVITY / 4.0, 0.0, 0.0, math.inf, False
        inertia, omega, rut, rows = 0.08 * self.mass * self.radius**2, [0.0] * 4, 0.0, []
        for i in range(int(duration / STEP)):
            t = i * STEP
            grip = self.soft if t > self.softens else (self.grip,) * 4
            turn, torque, force = self.yaw * V / self.speed, self.torques(t, omega), 0.0
            for k in range(4):
                ground, rim = V + SIDE[k] * turn * self.track / 2.0, self.radius * omega[k]
                s = (rim - ground) / max(rim, ground, 0.05)
                F = load * grip[k] * (1.35 * math.tanh(6.0 * s) - 0.35 * math.tanh(1.2 * s))
                if t > self.softens:
                    rut += self.digs * max(rim - ground, 0.0) * STEP / 4.0
                rolling = 0.02 * load * self.radius * math.tanh(20.0 * omega[k]) if torque[k] == 0.0 else 0.0
                omega[k] = max(omega[k] + (torque[k] - self.radius * F - rolling) / inertia * STEP, 0.0)
                force += F
            against = 4.0 * load * (self.base + rut + math.sin(self.slope) + 0.01 * math.sin(7.0 * t + seed))
            V = max(V + (force - against if V > 0.0 or force > against else 0.0) / self.mass * STEP, 0.0)
            moved |= self.speed * 0.3 < V
            stood = min(stood, t) if moved and V < 0.02 else stood
            if i % round(LOOK / STEP) == round(LOOK / STEP) // 2:
                rows.append([
                    t, V * (1.0 + 0.01 * normal()) + self.noise * normal(), turn + 0.01 * normal(),
                    (V - seen) / LOOK + 0.1 * normal(),
                    *(w * (1.0 + 0.01 * normal()) for w in omega), *(T * (1.0 + 0.02 * normal()) for T in torque),
                ])  # fmt: skip
                seen = V
        return np.array(rows), stood

    def alerts(self, window: Window) -> set[Alert]:
        """Everything that the watch reports."""
        return {state.warning for _, state in self.watched(window)}

    def warned(self, window: Window) -> list[float]:
        """When warnings begin [s]."""
        states = [(-math.inf, Watch()), *self.watched(window)]
        warned = [(t, state.warning is Alert.IMMOBILISATION) for t, state in states]
        return [t for (_, before), (t, now) in pairwise(warned) if now and not before]

    def watched(self, window: Window) -> list[tuple[float, Watch]]:
        """The watch at each look."""
        config, rig = Config(), self.rig
        config = config.model_copy(update={"estimator": replaced(config.estimator, min_speed=self.min_speed)})
        limit = np.full(4, self.limit * self.mass * GRAVITY / 4.0 * self.radius if self.known_limit else np.nan)
        state, out = Watch(), []
        for i in range(len(window.t)):
            moment = moment_of(forward(window.rows(np.arange(max(i - 2, 0), i + 1))), rig, limit, config)
            state = watched(state, moment, None, config)
            out.append((float(window.t[i]), state))
        return out


def replaced(section, **values):
    return section.model_copy(update=values)


TRACTOR = Machine("rear", mass=3000.0, radius=0.7, speed=1.5, base=0.08, digs=0.15)
BOGGED = {
    "rover": (Machine(), 0.4),
    "one motor's torque is unknown": (Machine(unknown=("torque.FR",)), 0.4),
    "rear-driven tractor": (replace(TRACTOR, soft=(0.45, 0.45, 0.25, 0.25)), 0.8),
    "one rear wheel spins": (replace(TRACTOR, soft=(0.7, 0.7, 0.1, 0.7)), 0.8),
    "diagonal spin on open differentials": (
        replace(TRACTOR, drive="open", soft=(0.06, 0.6, 0.6, 0.06), base=0.12), 0.5,
    ),
    "diagonal spin of four motors": (Machine(soft=(0.2, 0.5, 0.5, 0.2), digs=0.8), 0.1),
    "on a curve": (Machine(yaw=0.3, speed=1.2, digs=1.5), 0.3),
    "on a curve, the outer wheels unknown": (
        Machine(yaw=0.3, speed=1.2, digs=1.5, unknown=("speed.FR", "speed.RR")), 0.3,
    ),
    "on a curve, the inner wheels unknown": (
        Machine(yaw=0.3, speed=1.2, digs=1.5, unknown=("speed.FL", "speed.RL")), 0.3,
    ),
    "creeping": (Machine(speed=0.2, digs=3.0, gain=30.0, noise=0.005, min_speed=0.05), 0.0),
    "on mud, with little thrust": (Machine(grip=0.3, soft=(0.1,) * 4, base=0.05, digs=0.1), 0.5),
    "motors at their limit": (Machine(soft=(0.8,) * 4, digs=4.0, limit=0.3, base=0.15, known_limit=True), 0.5),
    "a start on soft ground": (Machine(softens=0.0, soft=(0.3,) * 4, base=0.15), 0.3),
}  # fmt: skip
FIRM = Machine(softens=math.inf)
ORDINARY = {
    "level": FIRM,
    "a hard start": replace(FIRM, ramp=0.8, gain=12.0),
    "gears": replace(FIRM, jerks=True, speed=1.2),
    "hard pull": replace(FIRM, base=0.62, ramp=1.0, gain=12.0),
    "uphill": replace(FIRM, slope=0.3),
    "uphill at the motors' limit": replace(FIRM, slope=0.2, limit=0.33, known_limit=True),
    "a tight curve": replace(FIRM, yaw=0.5, speed=1.0),
    "a tight curve, the outer wheels unknown": replace(FIRM, yaw=0.7, speed=1.0, unknown=("speed.FR", "speed.RR")),
    "a tight curve, the inner wheels unknown": replace(FIRM, yaw=0.7, speed=1.0, unknown=("speed.FL", "speed.RL")),
    "the driver stops": replace(FIRM, stops=12.0),
    "a tractor that stops": replace(TRACTOR, softens=math.inf, stops=12.0),
    "creeping": replace(FIRM, speed=0.2, gain=30.0, noise=0.005, min_speed=0.05),
    "mud": replace(FIRM, grip=0.3, base=0.1),
}


@pytest.mark.parametrize("case", BOGGED)
def test_every_machine_is_warned_before_it_stands(case):
    machine, lead = BOGGED[case]
    window, stood = machine.driven(1)
    assert stood < 25.0
    begun = machine.warned(window)
    assert begun
    assert machine.softens < begun[0] < stood - lead


@pytest.mark.parametrize("case", ORDINARY)
def test_ordinary_drives_are_left_in_peace_and_without_a_ground_speed_not_called_clear(case):
    machine = ORDINARY[case]
    window, _ = machine.driven(1)
    assert machine.warned(window) == []
    machine = without_ground_speed(machine)
    window, _ = machine.driven(1)
    assert machine.alerts(window) == {Alert.UNKNOWN}


def without_ground_speed(machine):
    return replace(machine, unknown=(*machine.unknown, "ground_speed"))


@pytest.mark.parametrize("case", ["rover", "rear-driven tractor", "one motor's torque is unknown"])
def test_a_machine_without_a_ground_speed_is_warned_by_its_acceleration(case):
    machine = without_ground_speed(BOGGED[case][0])
    window, stood = machine.driven(1)
    begun = machine.warned(window)
    assert begun
    assert machine.softens < begun[0] < stood


ON_ICE = Machine(softens=0.0, soft=(0.06, 0.7, 0.7, 0.06), base=0.3, digs=0.0, gain=1.5, ramp=4.0, known_limit=True)
"""A start with two wheels on ice: those spin at once, and the others push on until the vehicle moves after 3 s."""


def test_a_start_is_open_while_wheels_that_grip_have_torque_left():
    window, _ = ON_ICE.driven(1, 10.0)
    assert window.ground_speed[-1] > 0.4
    assert ON_ICE.warned(window) == []


@pytest.mark.parametrize("why", [{"limit": 0.5}, {"drive": "open"}])
def test_it_is_in_vain_where_they_have_none_left_or_a_differential_gives_them_none(why):
    machine = replace(ON_ICE, **why)
    window, _ = machine.driven(1, 10.0)
    assert window.ground_speed[-1] < 0.1
    assert machine.warned(window)


def test_a_bin_that_is_seen_twice_counts_once():
    machine = BOGGED["rover"][0]
    window, _ = machine.driven(1)
    config, limit, once, twice = Config(), np.full(4, np.nan), Watch(), Watch()
    for i in range(3, 40):
        moment = moment_of(window.rows(np.arange(i - 2, i + 1)), machine.rig, limit, config)
        once = watched(once, moment, CURVE, config)
        twice = watched(watched(twice, moment, CURVE, config), moment, CURVE, config)
    assert twice.stall == once.stall
    assert len(twice.margin.rows) == len(once.margin.rows) > 30


SLIPS = np.linspace(0.02, 0.6, 9)
CURVE = OverSlip(SLIPS, 8000.0 * SLIPS / (SLIPS + 0.3), np.full(9, 50.0), np.ones(9), np.ones(9))
"""Pull that still grows at the largest slip: there is a reserve however much the wheels slip."""


def judged(slip: float, pull: float = math.nan):
    """A certain go, whose forecast slip is 0.035 +- 0.003, while the wheels slip so much and give so much pull [N]."""
    known = Estimate(4000.0, 100.0)
    forecast = Forecast(Estimate(0.035, 0.003), {}, known, known, known)
    capability = Capability(known, None, None, None, known, known, "slip", {}, forecast, CURVE)
    go = Traversability(State.GO, 0.999, capability=capability, spare=known)
    watch = Watch(t=10.0, slip=slip, pull=pull)
    config = reference_configuration()
    return at_present(go, Basis(np.linspace(0.0, 10.0, 101), 0.1), watch, 10.0, config)


def test_a_go_does_not_stand_beside_a_slip_that_its_forecast_does_not_know():
    assert (judged(0.20).state, judged(0.20).contradicted) == (State.CAUTION, "slip")
    assert (judged(0.05).state, judged(0.05).contradicted) == (State.GO, None)


def test_where_the_pull_is_known_its_own_slip_is_what_counts():
    def pull(slip: float) -> float:
        return 8000.0 * slip / (slip + 0.3)

    assert judged(0.20, pull(0.035)).contradicted == "slip"
    assert judged(0.20, pull(0.20)).state is State.GO  # it accelerates, or pulls more than the demand was
    assert judged(0.35, pull(0.20)).contradicted == "slip"


def test_a_warning_that_only_lasts_ends_with_a_go_and_does_not_begin_again():
    state, config = Watch(), Config()
    for i in range(140):  # a draft grows to nearly all that there is
        draft = 3000.0 + 20.0 * i
        state = watched(state, look(0.1 * i, 0.3 * draft / (8000.0 - draft), draft), CURVE, config)
    assert (state.warning, state.is_caused) == (Alert.IMMOBILISATION, True)
    for i in range(140, 175):  # and is gone
        state = watched(state, look(0.1 * i, 0.04, 1000.0), CURVE, config)
    assert (state.warning, state.is_caused) == (Alert.IMMOBILISATION, False)
    over, log = ended(state, config), Warnings()
    for i in range(175, 215):
        over = watched(over, look(0.1 * i, 0.04, 1000.0), CURVE, config)
        log = log.after(0.1 * i, over.warning)
    assert log.begun == ()


@pytest.mark.parametrize("torque", [0.25, 0.35])
def test_the_common_slip_of_wheels_on_a_differential_hardly_grows_as_their_loads_shift(torque: float):
    def slip(load: float) -> float:
        """Slip at which 0.6 (1 - K / (l s) (1 - e^(-l s / K))) = torque / load, l / K = 8 (Janosi and Hanamoto)."""
        s = np.linspace(1e-3, 0.9, 9000)
        return float(np.interp(torque / load, 0.6 * (1.0 - (1.0 - np.exp(-8.0 * s)) / (8.0 * s)), s))

    even, shifted = slip(1.0), (slip(0.85), slip(1.15))
    assert abs(common_slip(shifted) - even) < 0.5 * abs(sum(shifted) / 2.0 - even)


def test_the_common_slip_of_wheels_that_slip_alike_is_their_slip():
    assert common_slip([0.12] * 4) == pytest.approx(0.12)
    assert common_slip([-0.05]) == pytest.approx(-0.05)
    assert math.isfinite(common_slip([-400.0, 0.1]))  # a wheel that hardly turns
