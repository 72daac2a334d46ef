"""Which sensor contradicts the others, though each of its readings is plausible by itself.

    slip s = 1 - V/(r omega), traction mu = T/(r W), weight: sum of W = m g cos(pitch) + draft's part,
    acceleration: dV/dt = a, balance: sum of T/r rises where draft + slope + inertia rises.

A window of bins is checked as a whole, on the instants at which the vehicle drives straight on, and only what lasts
counts.  Thresholds lie beyond what any soil, slope, driver or effect of `terra.effects` makes of good sensors; a fault
that a soil could imitate (a draft somewhat off, one wheel that slips more) is left to the model, which then does not
fit.  Each check sees the window without the channels that an earlier one has named.  Tuning values: `sensors.options`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from cantools.database.can import Database
from numpy.typing import NDArray

from soilbus.arrays import Array, Mask
from soilbus.can.channels import Channel
from soilbus.config.model import Estimator
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import Rig, SensorNoise, Window, pull_given, turning, zero_if_unknown
from soilbus.sensors.bins import bin_means
from soilbus.sensors.options import CONSISTENCY, ConsistencyOptions
from soilbus.terra.vehicle import GRAVITY, axle_loads, slip_ratio

SAME = 1e-12
"""Relative difference of means of equal readings: rounding."""


class Resolution(NamedTuple):
    """Step [SI] between two readings of a channel (0: none), and whether it reads 0 at rest or without load."""

    step: float
    rests_at_zero: bool


class ConsistencyInput:
    """Window of N bins of length `bin` [s] as the checks see it: driving (N,), slip and traction (N, W).

    window has values of every wheel (`instrumentation.completed`), raw the channels alone.  traction is torque over
    load and radius; slip is nan unless the vehicle drives straight on.  motor_speed [rad/s] (N, W) is at the wheel's
    side of the gear.  A contradiction must last for `sustained` bins, over which values change; `compared` changes are
    compared with each other.
    """

    def __init__(
        self,
        raw: Window,
        motor_speed: Array,
        rig: Rig,
        settings: Estimator,
        resolution: Mapping[str, Resolution],
        options: ConsistencyOptions,
    ) -> None:
        self.raw, self.motor_speed, self.rig, self.resolution, self.options = raw, motor_speed, rig, resolution, options
        self.window, self.bin = completed(raw, rig), settings.bin
        self.driving = (self.window.ground_speed > settings.min_speed) & ~turning(self.window, rig, settings.max_turn)
        self.traction = np.where(self.window.load > 0.0, self.window.torque / (rig.radius * self.window.load), np.nan)
        ground = np.where(self.driving, self.window.ground_speed, np.nan)[:, None]
        self.slip: Array = slip_ratio(rig.radius, self.window.speed, ground)
        bins = options.comparison_time / settings.bin
        self.sustained, self.compared = max(round(bins / 3.0), 1), max(round(bins), 1)


class SensorConsistency:
    """Checks whether sensors contradict each other; it keeps the speeds of the motors for that."""

    def __init__(self, rig: Rig, channels: Iterable[Channel], database: Database, settings: Estimator) -> None:
        self._rig, self._settings = rig, settings
        self._resolution = {c.name: resolution_of(c, database) for c in channels}
        motors = [f"motor_speed.{wheel}" for wheel in rig.wheels]
        self._heard: dict[str, list[tuple[Array, Array]]] = {name: [] for name in motors if name in self._resolution}

    def add(self, samples: Mapping[str, tuple[Array, Array]]) -> None:
        """Keep the motors' speeds among these samples (t [s], value in SI; both (N,)) by channel."""
        for name in self._heard.keys() & samples.keys():
            self._heard[name].append(samples[name])

    def checked(self, window: Window) -> tuple[Window, tuple[str, ...]]:
        """Return a forward window without the channels that contradict the others, and which these are."""
        names = implausible(window, self._rig, self._settings, self._resolution, self._motor_speed(window))
        return without(window, self._rig, set(names)), names

    def drop_before(self, t: float) -> None:
        """Forget the speeds of the motors before t [s]."""
        for name, heard in self._heard.items():
            self._heard[name] = [part for part in heard if part[0][-1] >= t]

    def _motor_speed(self, window: Window) -> Array:
        """Mean speeds [rad/s] of the motors in the window's bins (N, W), forward; nan where unknown."""
        length, n = self._settings.bin, len(window.t)
        speed = np.full((n, len(self._rig.wheels)), np.nan)
        for i, wheel in enumerate(self._rig.wheels if n else ()):
            if heard := self._heard.get(f"motor_speed.{wheel}"):
                t, value = (np.concatenate(parts) for parts in zip(*heard, strict=True))
                speed[:, i] = bin_means(t, np.abs(value), window.t[0] - length / 2.0, length, n)
        return speed


def resolution_of(channel: Channel, database: Database) -> Resolution:
    """Return the resolution of a channel by its signal; zero is what rests where its range ends there."""
    signal = database.get_message_by_name(channel.message).get_signal_by_name(channel.signal)
    step = 0.0 if signal.conversion.is_float else abs(channel.factor * float(signal.scale))
    ends = (signal.minimum, signal.maximum)
    unsigned = not signal.is_signed and float(signal.offset) == 0.0
    return Resolution(step, unsigned or any(end is not None and float(end) == 0.0 for end in ends))


@np.errstate(invalid="ignore", divide="ignore")  # of values that are not known
def implausible(
    window: Window,
    rig: Rig,
    settings: Estimator,
    resolution: Mapping[str, Resolution],
    motor_speed: Array | None = None,
    options: ConsistencyOptions = CONSISTENCY,
) -> tuple[str, ...]:
    """Return the channels of a forward window that contradict the others, in the order of rig.channels.

    resolution: by channel name; motor_speed: [rad/s] (N, W), nan where unknown, named as "motor_speed.FL".
    """
    motor = np.full(window.speed.shape, np.nan) if motor_speed is None else motor_speed
    data = ConsistencyInput(window, motor, rig, settings, resolution, options)
    if not data.driving.any():
        return ()
    named: set[str] = set()
    for check in CHECKS:
        if found := set(channels_behind(rig, check(data))):
            named |= found
            window = without(window, rig, found)
            motor = np.where([f"motor_speed.{w}" in found for w in rig.wheels], np.nan, motor)
            data = ConsistencyInput(window, motor, rig, settings, resolution, options)
    order = (*rig.channels, *(f"motor_speed.{w}" for w in rig.wheels))
    return tuple(name for name in order if name in named)


def without(window: Window, rig: Rig, channels: set[str]) -> Window:
    """Return the window without any reading of these channels."""
    values: dict[str, Any] = {}
    for i, name in enumerate(rig.channels):
        if name in channels:
            quantity, _, wheel = name.partition(".")
            values.setdefault(quantity, getattr(window, quantity).copy())
            values[quantity][..., i % len(rig.wheels) if wheel else slice(None)] = np.nan
    return replace(window, **values) if values else window


def channels_behind(rig: Rig, names: Iterable[str]) -> Iterator[str]:
    """Yield the channels that values of wheels rest on; none for a value that is computed."""
    for name in names:
        quantity, _, wheel = name.partition(".")
        if rig.instrumentation is None or quantity not in ("torque", "speed", "load") or wheel not in rig.wheels:
            yield name
            continue
        place = rig.wheels.index(wheel)
        for row in getattr(rig.instrumentation, quantity):
            if row.kind == "channel" and row.weight[place]:
                yield f"{quantity}.{row.name}"


def frozen(data: ConsistencyInput) -> Iterator[str]:
    """Yield channels that read the very same for longer than their noise allows, while the vehicle drives."""
    window, rig, rare = data.raw, data.rig, 1.0 - data.options.usual_share
    quantities = list(dict.fromkeys(name.partition(".")[0] for name in rig.channels))
    value = np.column_stack([getattr(window, q) for q in quantities])
    same = np.abs(np.diff(value, axis=0)) <= SAME * np.abs(value[1:])
    same &= data.driving[1:, None]
    variance = np.column_stack([window.variance[q] for q in quantities])
    chance = math.erfc(data.options.significant_sd / math.sqrt(2.0))
    for i in np.flatnonzero(same.sum(axis=0) >= data.sustained).tolist():
        name = rig.channels[i]
        noise, resolution = rig.noise[name.partition(".")[0]], data.resolution.get(name, Resolution(0.0, False))
        stretches = [(first, last) for first, last in runs(same[:, i]) if last - first >= data.sustained]
        within = sum(last - first for first, last in stretches)
        if same[:, i].sum() - within > rare * (np.isfinite(value[:, i]).sum() - within):
            continue  # a sensor coarser than its signal
        if any(_stuck(float(value[a, i]), variance[a : b + 1, i], noise, resolution, chance) for a, b in stretches):
            yield name


def _stuck(value: float, variance: Array, noise: SensorNoise, resolution: Resolution, probability: float) -> bool:
    """Whether noise leaves a reading the same in bins of these variances (N,) with less than this probability.

    Noise leaves a sample in the reading's step with the chance erf(step / (2 sqrt(2) sd)) at most.
    """
    of_sample = noise.absolute**2 + (noise.relative**2 + noise.of_mean**2) * value**2
    if of_sample == 0.0 or not np.all(variance > 0.0):  # exact: no sensor's, such as a draft that is known to be 0
        return False
    if resolution.rests_at_zero and abs(value) <= resolution.step:
        return False
    samples = float((of_sample / variance).sum())
    same = math.erf(resolution.step / (2.0 * math.sqrt(2.0 * of_sample)))
    return (samples - 1.0) * math.log(max(same, probability)) < math.log(probability)


def gear_ratio(data: ConsistencyInput) -> Iterator[str]:
    """Yield the speed that is farther from the other wheels' where a wheel and its motor disagree.

    Both, where this is so of most wheels: the gear ratio may be wrong, and the torques with it.
    """
    window, rig, motor, options = data.window, data.rig, data.motor_speed, data.options
    if not np.isfinite(motor).any():
        return
    slack = options.gear_slack * np.abs(window.speed)
    slack += options.significant_sd * np.sqrt(2.0 * window.variance["speed"])
    apart = data.driving[:, None] & (np.abs(motor - window.speed) > slack)
    wrong = [i for i in range(len(rig.wheels)) if lasts(apart[:, i], data.sustained)]
    good = [i for i in range(len(rig.wheels)) if i not in wrong]
    for i in wrong:
        names = [f"speed.{rig.wheels[i]}", f"motor_speed.{rig.wheels[i]}"]
        if len(wrong) > len(good):
            yield from names
            continue
        where = apart[:, i]
        usual = median((rig.radius * window.speed)[where][:, good])
        off = [abs(median(rig.radius[i] * speed[where, i]) - usual) for speed in (window.speed, motor)]
        yield names[int(off[1] > off[0])]


def load_sum(data: ConsistencyInput) -> Iterator[str]:
    """Yield the load that alone explains why the loads do not add up to the weight; all where none can."""
    window, rig, chassis, options = data.window, data.rig, data.rig.chassis, data.options
    if chassis is None or set(rig.front.tolist()) != {True, False}:
        return
    draft, pitch, acceleration = (zero_if_unknown(a) for a in (window.draft, window.pitch, window.acceleration))
    due = np.stack(axle_loads(chassis, draft, pitch, acceleration), axis=1)
    has = window.load @ np.stack([rig.ahead, 1.0 - rig.ahead], axis=1)
    excess = (has - due) / (chassis.mass * GRAVITY)
    wrong = data.driving & (np.abs(excess.sum(axis=1)) > options.load_error)
    if not lasts(wrong, data.sustained):
        return
    front, rear = np.median(excess[wrong], axis=0)
    if not -options.any_load < front + rear < options.any_load:
        yield from (f"load.{wheel}" for wheel in rig.wheels)
        return
    bad, sound = np.flatnonzero(rig.front), np.flatnonzero(~rig.front)
    if abs(rear) > abs(front):
        bad, sound = sound, bad
    is_carried = min(abs(front), abs(rear)) > options.load_error
    if is_carried or not len(bad) == len(sound) == 2:
        return
    load = window.load[wrong]
    left, other = (median(load[:, pair[0]] / load[:, pair].sum(axis=1)) for pair in (bad, sound))
    if abs(left - other) > options.load_error:
        yield f"load.{rig.wheels[bad[int((left > other) != (front + rear > 0.0))]]}"


def slip_without_traction(data: ConsistencyInput) -> Iterator[str]:
    """Yield torques or speeds of wheels that slip without driving, or drive without slipping or turning."""
    window, rig, slip, grip, options = data.window, data.rig, data.slip, data.traction, data.options
    idle = (slip > options.feigned_slip) & (grip < options.idle_traction)
    dragged = (slip < -options.feigned_slip) & (grip > options.driving_traction)
    still = rig.radius * window.speed < (1.0 - options.usual_share) * window.ground_speed[:, None]
    stands = data.driving[:, None] & still & ~(grip < -options.driving_traction)  # nor braked
    rolls = still & (np.abs(grip) < options.idle_traction)
    wheels = range(len(rig.wheels))
    idles, drags, stood = ([i for i in wheels if lasts(at[:, i], data.sustained)] for at in (idle, dragged, stands))
    if 2 * len(drags) > len(wheels) or lasts(np.asarray((stands & rolls).all(axis=1)), data.sustained):
        yield "ground_speed"
        return
    yield from (f"speed.{rig.wheels[i]}" for i in stood)
    chassis, asked, least = rig.chassis, window.draft, 0.0
    if chassis is not None:
        asked = pull_given(window, chassis)
        least = options.driving_traction / 3.0 * chassis.mass * GRAVITY
    if len(idles) == len(wheels) and not median(asked[np.asarray(idle.all(axis=1))]) > least:
        yield "ground_speed"  # or the torques: coasting at a ground speed that is reported too low looks the same
    yield from (f"torque.{rig.wheels[i]}" for i in idles)
    drags = [i for i in drags if i not in stood]
    others = [i for i in wheels if i not in {*idles, *drags, *stood}]
    for i in drags:
        where = dragged[:, i]
        odd = abs(median(slip[where, i]) - median(slip[where][:, others])) > options.feigned_slip  # nor nan
        yield f"{'speed' if odd else 'torque'}.{rig.wheels[i]}"


def wheel_derived_speed(data: ConsistencyInput) -> Iterator[str]:
    """Yield the ground speed where it is the rim speed of pulling wheels: no slip, nor more as they pull more."""
    options, every = data.options, list(range(len(data.rig.wheels)))
    least = options.slip_per_traction * options.driving_traction
    for wheels in (*data.rig.axles, every):
        slip, grip = data.slip[:, wheels].mean(axis=1), data.traction[:, wheels].mean(axis=1)
        known = np.isfinite(slip) & np.isfinite(grip)
        slip, grip = slip[known], grip[known]
        pulling = grip > options.driving_traction
        if pulling.sum() < data.compared or median(np.abs(slip[pulling])) >= least:
            continue
        r = float(np.corrcoef(grip, slip)[0, 1])
        if r < 0.0 or r**2 * (len(slip) - 2) < options.significant_sd**2 * (1.0 - r**2):  # does not follow it
            yield "ground_speed"
            return


def scale_of_acceleration(data: ConsistencyInput) -> Iterator[str]:
    """Yield the acceleration if it falls when speed is gained; it or the ground speed if their changes differ much.

    A ground speed that jumps is the one; else both are named unless the slip would be impossible with one of them
    false.
    """
    window, lag, n = data.window, data.sustained, data.compared
    smooth = neighbours(np.pad(window.ground_speed, 1, "edge"), 3).mean(axis=-1)
    gained = np.where(data.driving[lag:], change(smooth, lag), np.nan)
    is_known = np.isfinite(window.pitch) | (not data.rig.specific_force)
    reported = data.bin * moving_sum(np.where(is_known, window.acceleration, np.nan), lag)
    if len(reported) < n:
        return
    scale = _scales(gained, reported, n, lag // 2, data.options)
    if lasts(scale < 0.0, lag):
        yield "acceleration"
        return
    wrong = np.abs(np.log(np.abs(scale))) > math.log(data.options.scale_ratio)  # nor nan
    if wrong.any() and _jumps(data):
        yield "ground_speed"
        return
    if not lasts(wrong, lag):
        return
    within = np.convolve(wrong, np.ones(n)) > 0.0  # in the stretches of n instants that begin there
    factor, seen = median(scale[wrong]), median(data.slip[lag:][within])
    if not 1.0 - (1.0 - seen) / factor < -data.options.feigned_slip:
        yield "ground_speed"
    if not seen < -data.options.feigned_slip:
        yield "acceleration"


def _scales(gained: Array, reported: Array, n: int, late: int, options: ConsistencyOptions) -> Array:
    """Ratios of speed gained to acceleration reported (both (M,)) in each n neighbours, (M - n + 1,); nan where unsure.

    Either may be late by up to `late` bins; of the delays with which they go together the one counts with which they
    are most alike.
    """
    nothing = np.full(late, np.nan)
    moved = neighbours(np.concatenate([nothing, reported, nothing]), len(reported))
    known = np.isfinite(gained) & np.isfinite(moved)
    one, other = np.where(known, gained, 0.0), np.where(known, moved, 0.0)
    both, of_one, of_other, count = neighbours(np.stack([one * other, one**2, other**2, known]), n).sum(axis=-1)
    enough = (count >= options.usual_share * n) & (of_one > 0.0) & (of_other > 0.0)
    together = np.divide(both, np.sqrt(of_one * of_other), where=enough, out=np.zeros(both.shape))
    fits = 1.0 - together**2 < options.scatter**2
    scale = np.divide(both, of_other, where=fits, out=np.full(both.shape, np.inf))
    best = np.argmin(np.abs(np.log(np.abs(scale))) + np.where(scale < 0.0, np.log(options.scale_ratio), 0.0), axis=0)
    chosen = np.take_along_axis(scale, best[None], axis=0)[0]
    return np.where(np.isfinite(chosen), chosen, np.nan)


def _jumps(data: ConsistencyInput) -> bool:
    """Whether the ground speed changes at once by what no acceleration about that time explains."""
    window, late = data.window, max(data.sustained // 2, 1)
    lag = max(late // 2, 1)  # a change faster than their delay
    jump = np.abs(change(window.ground_speed, lag))
    noise = np.sqrt(change_variance(window.variance["ground_speed"], lag))
    reported = np.abs(data.bin * moving_sum(zero_if_unknown(window.acceleration), lag))
    most = neighbours(np.pad(reported, late), 2 * late + 1).max(axis=1)
    stands_out = (jump > data.options.significant_sd * noise) & (most < data.options.scatter * jump)
    return bool((data.driving[lag:] & stands_out).any())


def draft_sign(data: ConsistencyInput) -> Iterator[str]:
    """Yield the draft where it pushes the vehicle, and the more so the more its wheels drive.

    On soft ground it may also pull less when its wheels drive more, for they sink; but it pulls.
    """
    window, rig, chassis, options = data.window, data.rig, data.rig.chassis, data.options
    if chassis is None:
        return
    lag, weight, variance = data.sustained, chassis.mass * GRAVITY, window.variance
    known = data.driving & np.isfinite(window.pitch) & np.isfinite(window.acceleration)
    thrust = (window.torque / rig.radius).sum(axis=1)
    pulled = np.where(known, pull_given(window, chassis), np.nan)
    of_thrust = (variance["torque"] / rig.radius**2).sum(axis=1)
    of_pull = variance["draft"] + weight**2 * variance["pitch"] + chassis.mass**2 * variance["acceleration"]
    driven, pull = change(thrust, lag), change(pulled, lag)
    stands_out = np.abs(driven) > options.significant_sd * np.sqrt(change_variance(of_thrust, lag))
    stands_out &= np.abs(pull) > options.significant_sd * np.sqrt(change_variance(of_pull, lag))
    opposite = neighbours((driven * pull)[stands_out] < 0.0, data.compared).sum(axis=-1)
    if median(pulled * thrust) < 0.0 and (opposite >= options.usual_share * data.compared).any():
        yield "draft"


def change(values: Array, lag: int) -> Array:
    """Return the changes (N - lag,) over `lag` bins of values (N,), in their unit."""
    return values[lag:] - values[:-lag]


def change_variance(variance: Array, lag: int) -> Array:
    """Return the variances (N - lag,) of such changes where values (N,) have independent variances."""
    return variance[lag:] + variance[:-lag]


def moving_sum(values: Array, lag: int) -> Array:
    """Return the sums (N - lag,) from each bin's middle to that of the one `lag` later."""
    return np.asarray(neighbours((values[1:] + values[:-1]) / 2.0, lag).sum(axis=-1))


def neighbours(values: NDArray[Any], n: int) -> Array:
    """Return each n neighbours of (..., N), (..., N - n + 1, n); none where there are fewer.

    Not numpy's view of them: each call leaves a used place in Python's table of strings, which after hours doubles.
    """
    return np.asarray(values[..., np.arange(values.shape[-1] - n + 1)[:, None] + np.arange(n)])


def median(values: Array) -> float:
    """Return the median of the known values; nan of none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def lasts(holds: Mask, bins: int) -> bool:
    """Return whether something holds in this number of bins in a row."""
    return bool(np.count_nonzero(holds) >= bins and neighbours(holds, bins).all(axis=-1).any())


def runs(holds: Mask) -> list[tuple[int, int]]:
    """Return the first index of each run of True, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


CHECKS: Sequence[Callable[[ConsistencyInput], Iterator[str]]] = (
    frozen, gear_ratio, load_sum, slip_without_traction, wheel_derived_speed,
    scale_of_acceleration, draft_sign,
)  # fmt: skip
"""In their order: what one names the next ones do not see."""
