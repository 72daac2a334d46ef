"""What a recording says of candidate signals: seen or not, and what moves with what.

slip against the wheels     relative sd of v / omega over 0.2 s bins: next to none for a speed made of wheels'
gear ratio                  median(|omega_motor / omega_wheel|)
accelerometer               a - dv/dt = k g sin(pitch): k = 1 feels gravity, k = 0 does not
mass                        median(sum of loads) / g
radius less slip            median(v / omega)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from cantools.database.can import Database

from soilbus.arrays import Array
from soilbus.can.admission import Admission
from soilbus.can.candump import Frame
from soilbus.can.channels import Channel
from soilbus.can.decode import check_decodable
from soilbus.can.role_matching import ASSERTED, WHEELS, Assignment, Candidate, Slot, axles_of
from soilbus.can.units import STANDARD_GRAVITY
from soilbus.sensors.bins import bin_means
from soilbus.sensors.consistency import median
from soilbus.sensors.facts import LIMITS, longest_part, regression

BIN = 0.2
"""Time [s] over which samples are averaged before they are compared: a few frames of each sensor."""
LEAST_BINS = 50
"""Bins in which the vehicle moves, from which anything is compared: 10 s."""
MOVING = 0.2
"""Ground speed [m/s] from which the vehicle moves: `estimator.min_speed`."""
RIGID = 0.006
"""Largest relative sd of the ratio of two speeds of parts that turn together; slip has ten times as much."""
SAME_GEAR = 0.02
"""Relative difference of two measured gear ratios up to which they are one: gain errors; gear steps are larger."""
ABSENT, REFUSED = 0.9, 0.6
"""Score that a signal loses that is never seen, or never available: it is then open, not asserted."""
MOVES_WITH = 0.7
"""Score that a ground speed gains which follows the wheels but slips against them."""


class Recording:
    """Samples (SI, no gear) and numbers of refused values of signals by `Message.Signal`; its begin and length [s]."""

    def __init__(self, found: Iterable[Candidate], database: Database, frames: Iterable[Frame]) -> None:
        channels: dict[str, Channel] = {}
        owner: dict[tuple[int, bool], str] = {}
        for c in found:
            message = database.get_message_by_name(c.message)
            if owner.setdefault((message.frame_id, message.is_extended_frame), c.message) == c.message:
                with suppress(ValueError):
                    check_decodable(message, c.signal)
                    channels[c.path] = Channel(c.path, "", c.message, c.signal, c.factor, 0.0, -math.inf, math.inf)
        self.columns, self.refused, _ = longest_part(Admission(channels.values(), database), frames)
        self.start = min((float(t[0]) for t, _ in self.columns.values()), default=0.0)
        self.seconds = max((float(t[-1]) for t, _ in self.columns.values()), default=0.0) - self.start

    def mean(self, path: str) -> Array:
        """Return the means over bins from the begin to the end; nan where there is no sample."""
        t, value = self.columns.get(path, (np.empty(0), np.empty(0)))
        return bin_means(t, value, self.start, BIN, math.ceil(self.seconds / BIN))


@dataclass(frozen=True, slots=True)
class Facts:
    """What a recording says of the machine; an empty entry is not known.

    gear_ratio, radius [m] less the usual slip: by place; per_metre: motor speed over wheel speed [1/m] where the
    latter is in m/s; backward: signals that read the other way round, and for how much of the drive; kind of the
    accelerometer; mass [kg]: sum of the loads; axle of a motor whose place no name says.
    """

    gear_ratio: dict[str, float] = field(default_factory=dict)
    per_metre: dict[str, float] = field(default_factory=dict)
    radius: dict[str, float] = field(default_factory=dict)
    backward: dict[str, str] = field(default_factory=dict)
    kind: str = ""
    mass: float = math.nan
    axle: str = ""


def weighed(found: Sequence[Candidate], recording: Recording) -> list[Candidate]:
    """Return the candidates with what the recording says for or against each."""
    turning, out = _turning(found, recording), []
    for c in found:
        if c.path not in recording.columns:
            refused = sum(n for (path, _), n in recording.refused.items() if path == c.path)
            what = f"never available in {refused} frames" if refused else "no frame of it in the log"
            out.append(replace(c.changed(-REFUSED if refused else -ABSENT, what), absent=True))
            continue
        t, value = recording.columns[c.path]
        rate = f"{(len(t) - 1) / max(float(t[-1] - t[0]), 1e-9):.3g}/s" if len(t) > 1 else "once"
        low, high = float(value.min()), float(value.max())
        c = c.changed(0.0, f"{rate}, {low:.4g} all along" if low == high else f"{rate}, {low:.4g} to {high:.4g} SI")
        out.append(_as_ground_speed(c, recording, turning) if c.slot.role == "ground_speed" else c)
    return out


def facts_of(assignment: Assignment, recording: Recording) -> Facts:
    """Return gear ratios, signs, kind of the accelerometer, mass and radii, by the asserted signals."""
    asserted = assignment.asserted

    def read(role: str, place: str = "") -> Array:
        c = asserted.get(Slot(role, place))
        factor = STANDARD_GRAVITY if c is not None and c.dimension == "mass" else 1.0
        return factor * recording.mean("" if c is None else c.path)

    ground = read("ground_speed")
    moving = np.abs(ground) > MOVING
    if moving.sum() < LEAST_BINS:
        moving = np.ones(len(ground), bool)
    axles = axles_of(assignment)
    wheels = [wheel for pair in axles.values() for wheel in pair]
    speed = {w: read("speed", w) for w in wheels}
    speed |= {axle: (speed[left] + speed[right]) / 2.0 for axle, (left, right) in axles.items()}
    cells = [places for places in (wheels, list(axles)) if all(Slot("load", p) in asserted for p in places)]
    facts = Facts(
        kind=_kind(read("acceleration"), ground, read("pitch")),
        mass=median(np.sum([read("load", p) for p in cells[0]], axis=0)) / STANDARD_GRAVITY if cells else math.nan,
        axle=_driven_axle(read("motor_speed")[moving], {axle: speed[axle][moving] for axle in axles}),
    )
    for place, wheel in speed.items():
        own = "" if place == facts.axle else place
        motor = read("motor_speed", own if Slot("motor_speed", own) in asserted else place)
        of_wheel = asserted.get(Slot("speed", axles[place][0] if place in axles else place))
        if of_wheel is not None and _scatter(motor[moving], wheel[moving]) < 5.0 * RIGID:
            ratios = facts.gear_ratio if of_wheel.dimension == "rotation" else facts.per_metre
            ratios[place] = median(np.abs(motor[moving] / wheel[moving]))
        turning = moving & (wheel != 0.0)
        radius = median(np.abs(ground[turning] / wheel[turning]))
        own_speed = asserted.get(Slot("speed", place))
        if own_speed is not None and own_speed.dimension == "rotation" and math.isfinite(radius):
            facts.radius[place] = radius
    of_wheels = {place: ratio for place, ratio in facts.gear_ratio.items() if place in WHEELS}
    if of_wheels and max(of_wheels.values()) < (1.0 + SAME_GEAR) * min(of_wheels.values()):
        # gears of one kind on all wheels: the median is free of each sensor's gain error
        facts.gear_ratio.update(dict.fromkeys(of_wheels, float(np.median([*of_wheels.values()]))))
    forward = np.where(np.isfinite(ground), np.sign(ground), 1.0)
    for slot, c in asserted.items():
        if slot.role in ("speed", "motor_speed", "torque", "draft"):
            value = (read(*slot) * (1.0 if slot.role == "draft" else forward))[moving]
            value = value[np.isfinite(value)]
            if len(value) >= LEAST_BINS and np.median(np.sign(value)) < 0.0:
                facts.backward[c.path] = f"{np.mean(value < 0.0):.0%} of the drive"
    return facts


def _turning(found: Iterable[Candidate], recording: Recording) -> Array:
    """A mean of wheels or motors, whose speed each is divided by its own median (bins,)."""
    turns = [c for c in found if c.slot.role in ("speed", "motor_speed") and c.slot.place and c.score >= ASSERTED]
    parts = [recording.mean(path) for path in dict.fromkeys(c.path for c in turns)]
    scaled = [part / size for part in parts if (size := median(np.abs(part))) > 0.0]
    return np.asarray(np.mean(scaled, axis=0)) if scaled else recording.mean("")


def _as_ground_speed(c: Candidate, recording: Recording, turning: Array) -> Candidate:
    """A ground speed slips against the wheels; one that does not is computed from them."""
    ground = np.abs(recording.mean(c.path))
    known = (ground > MOVING) & (np.abs(turning) > 0.1)
    if known.sum() < LEAST_BINS:
        return c
    pair = np.stack([ground[known], np.abs(turning[known])])
    if _scatter(*pair) < RIGID:
        return c.changed(-MOVES_WITH, "turns with the wheels: no slip in it, or a drive on a road")
    if pair.std(axis=1).all() and float(np.corrcoef(pair)[0, 1]) > 0.5:
        return c.changed(MOVES_WITH, "follows the wheels and slips against them")
    return c


def _kind(acceleration: Array, ground: Array, pitch: Array) -> str:
    """kinematic or specific_force, "" where the slope varies too little to say."""
    if len(ground) < LEAST_BINS:
        return ""
    width = round(1.0 / BIN)
    force, speed, slope = (np.convolve(a, np.full(width, BIN), "same") for a in (acceleration, ground, np.sin(pitch)))
    rows = np.stack([force - np.gradient(speed, BIN), STANDARD_GRAVITY * slope], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < LEAST_BINS or rows[:, 1].std() < STANDARD_GRAVITY * LIMITS.tilted:
        return ""
    rows -= rows.mean(axis=0)
    (share,), (sd,) = regression(rows[:, 0], rows[:, 1:])
    sd *= math.sqrt(width)  # as many neighbours share their samples
    if sd > 0.12 or min(abs(share), abs(share - 1.0)) > 0.35:
        return ""
    return "specific_force" if share > 0.5 else "kinematic"


def _driven_axle(motor: Array, axles: Mapping[str, Array]) -> str:
    """The axle that turns with a motor whose place no name says, where no other one does."""
    scatter = {axle: _scatter(motor, speed) for axle, speed in axles.items()}
    near, far, *_ = sorted(scatter, key=lambda axle: scatter[axle])
    return near if scatter[near] < RIGID and scatter[far] > 3.0 * scatter[near] else ""


def _scatter(one: Array, other: Array) -> float:
    """Relative sd of the ratio of two speeds, by its quantiles; inf where hardly known together."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(one / other)
    ratio = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    if len(ratio) < LEAST_BINS:
        return math.inf
    low, middle, high = np.quantile(ratio, [0.16, 0.5, 0.84])
    return float((high - low) / 2.0 / middle)
