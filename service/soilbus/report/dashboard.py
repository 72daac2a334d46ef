"""The dashboard's knowledge: what our frames say now and said in the last minute, in words.

It judges them by the rules of dbc/README.md; the pages (`driver_page`, `engineer_page`) draw it, `sentences` say it.
"""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from rich.style import Style

from soilbus.config.model import Config
from soilbus.report.received_frames import IN_A_ROW, ReceivedFrames

SAMPLE_PERIOD = 0.1
"""Least time [s] between two samples of the history: the cycle of the fast frames."""
LONGEST_HOLD = 0.5
"""Time [s] for which a sample stands where none follows: more than twice the time between two pictures."""
TOP_TIME_LEFT = 25.0
"""Top of the range [s] of DemandForecast.TimeLeft: this long or longer."""
HISTORIES = {
    "draft": ("PresentDemand", "Draft"),
    "bearing": ("SoilStrength", "BearingPressure"),
    "chi2": ("SoilStrength", "Chi2"),
    "rejected": ("WindowQuality", "Rejected"),
}
"""Signals that charts show as they are."""
WHEELS = 8
"""Wheels of which our frames can speak."""

NAMES = {"go": "GO", "caution": "CAUTION", "no_go": "NO-GO", "unknown": "UNKNOWN"}
ADVICE = {
    ("go", None): "Keep going",
    ("caution", "torque"): "Less draft, motor limit",
    ("caution", "traction"): "Less draft, more load",
    ("caution", "slip"): "Less draft, more load",
    ("caution", "sinkage"): "Less load, firmer ground",
    ("caution", None): "Go slowly, watch the slip",
    ("no_go", "torque"): "Stop, reduce the draft",
    ("no_go", "sinkage"): "Stop, turn off soft ground",
    ("no_go", None): "Stop, lift the implement",
    ("go", "stuck"): "Lift, add no torque",
    ("caution", "stuck"): "Lift, add no torque",
    ("no_go", "stuck"): "Stop, lift, add no torque",
    ("unknown", "stuck"): "Stop, lift, add no torque",
}
"""What to do by state and limiting cause, in at most five words: a stop only where the state does not say go on."""
UNLADEN = "Go slowly, add no torque", "Stop, add no torque"
"""The same without and with a stop, where nothing is pulled and the advice would name draft or implement."""
HELD = {"caution": "Go slowly, caution is held", "no_go": "Stop, no-go is held"}
GONE_ADVICE = "Rely on your own judgement"
MEASURING = "Go slowly, still measuring"
COLOURS = {
    "go": ("#000000", "#00d700"),
    "caution": ("#000000", "#ffd700"),
    "no_go": ("#ffffff", "#870000"),
    "warned": ("#ffffff", "#5f005f"),
    "unknown": ("#000000", "#d0d0d0"),
    "gone": ("#ffffff", "#303030"),
}
"""Foreground and background by kind of verdict: of the fixed colours of a 256-colour terminal, as its theme sets
the first 16; contrast by WCAG 2 above 7 (level AAA)."""
REASONS = {
    "bus_down": ("the bus is down", "Check the CAN connection"),
    "bus_error": ("the bus has errors", "Check the CAN connection"),
    "no_frames": ("nothing on the bus", "Check the CAN connection"),
    "standstill": ("standing still", "Drive on to measure"),
    "not_excited": ("load or slip hardly varies", "Go carefully, vary the load"),
    "ambiguous": ("several soils fit", "Go carefully, vary the load"),
    "turning": ("turning", "Drive straight to measure"),
    "input_missing": ("an input never came", "Check the sensors"),
    "input_stale": ("an input stopped", "Check the sensors"),
    "input_rejected": ("an input is refused", "Check the sensors"),
    "implausible": ("a sensor contradicts the others", "Check the sensors"),
    "foreign_sender": ("another node sends our frames", "Remove the second soilbus"),
    "model_mismatch": ("the model does not fit", GONE_ADVICE),
    "no_convergence": ("no soil fits", GONE_ADVICE),
    "overload": ("soilbus is too slow", GONE_ADVICE),
    "internal": ("soilbus has a defect", GONE_ADVICE),
}
"""What the service's reason means, and what to do while the state is unknown for it."""
CARRYING_SLIP = 0.6
"""Slip [1] below which wheels still carry the vehicle on: the default of traversability.max_slip."""


class Verdict(NamedTuple):
    """Verdict in a word, in a sentence, what to do, and the kind of its colours."""

    word: str
    said: str
    todo: str
    kind: str

    @property
    def style(self) -> Style:
        """Colours of the verdict, reversed: a terminal without colour then shows it in reverse video."""
        foreground, background = COLOURS[self.kind]
        return Style(color=background, bgcolor=foreground, reverse=True, bold=True)


@dataclass(frozen=True)
class Vehicle:
    """Names and limits that a configuration adds to the frames.

    Wheels are named in the order of the frames, or not at all; axles are `Front` or `Rear` as in the names of signals.
    A window is `window` [s] long, the slip bar ends at `max_slip`, and the state is go from the probability `go` on.
    """

    wheels: tuple[str, ...] = ()
    axles: tuple[str | None, ...] = ()
    window: float = 10.0
    max_slip: float = 0.6
    go: float = 0.95

    @classmethod
    def of(cls, config: Config, names_wheels: bool = True) -> Vehicle:
        """Return what a configuration adds; without names where it is not that of the watched vehicle."""
        wheels = config.wheel if names_wheels else []
        return cls(
            tuple(w.name for w in wheels),
            tuple(w.axle and ("Front" if config.axles[w.axle] == 1.0 else "Rear") for w in wheels),
            config.estimator.window, config.traversability.max_slip, config.traversability.go,
        )  # fmt: skip

    def name(self, wheel: int) -> str:
        """Return the name of a wheel, numbered from 0; its number from 1 where it has none."""
        return self.wheels[wheel] if wheel < len(self.wheels) else str(wheel + 1)


class Slip(NamedTuple):
    """Slip of the wheel that slips most, that wheel's name, and the set-points of its axle; None where not known."""

    value: float | None = None
    wheel: str = ""
    best: float | None = None
    most_pull: float | None = None


@dataclass
class Dashboard:
    """Received frames and their last minute, as the dashboard shows them.

    `fault` says why the bus is away; it is empty while it is there. `is_over` says that the recording has ended.
    Charts show the last `span` seconds.
    """

    known: ReceivedFrames
    vehicle: Vehicle = field(default_factory=Vehicle)
    fault: str = ""
    span: float = 60.0
    is_over: bool = False
    _samples: deque[tuple[float, dict[str, float]]] = field(default_factory=deque, repr=False)
    _began: float = math.nan

    def __post_init__(self) -> None:
        self._began = self.known.now

    def sample(self) -> None:
        """Take the present values into the history; call it for each frame and each picture."""
        now, known = self.known.now, self.known
        if self._samples and 0.0 <= now - self._samples[-1][0] < SAMPLE_PERIOD:
            return
        values = {name: known.number(*signal) for name, signal in HISTORIES.items()}
        values |= {"max_draft": self.max_draft(), "slip": self.slip().value}
        self._samples.append((now, {name: value for name, value in values.items() if value is not None}))
        while self._samples[0][0] < now - self.span or self._samples[0][0] > now:
            self._samples.popleft()

    def history(self, name: str, columns: int) -> list[float | None]:
        """Return a value over the last `span` seconds, oldest first, one for each column.

        None where it was not known for LONGEST_HOLD.
        """
        start, width = self.known.now - self.span, self.span / columns
        samples, last = deque(self._samples), (-math.inf, dict[str, float]())
        held: list[float | None] = []
        for column in range(columns):
            end = start + (column + 1) * width
            while samples and samples[0][0] <= end + 1e-9:
                last = samples.popleft()
            held.append(last[1].get(name) if end - last[0] <= max(LONGEST_HOLD, width) else None)
        return held

    def verdict(self) -> Verdict:
        """Return the verdict and what to do; without fresh frames there is no verdict."""
        known, silence = self.known, self.known.age("SoilbusStatus", "Traversability")
        if known.is_stale("SoilbusStatus") and known.is_stale("Traversability"):
            if silence is None:
                said = f"no frame of soilbus yet, {known.now - self._began:.0f} s"
                return Verdict("WAIT", f"UNKNOWN: {said}", "Check that soilbus runs", "gone")
            return Verdict("GONE", f"UNKNOWN: soilbus is gone, for {silence:.0f} s", GONE_ADVICE, "gone")
        state = str(known.value("Traversability", "State"))
        state = state if state in NAMES else "unknown"
        if known.value("DemandForecast", "Warning") == "immobilisation":
            slip = self.slip().value
            moves = slip is not None and slip < CARRYING_SLIP
            is_stuck = state == "no_go" and known.number("Traversability", "Probability") == 0.0 and not moves
            left = known.number("DemandForecast", "TimeLeft")
            when = "" if left is None or left >= TOP_TIME_LEFT else " now" if round(left) == 0 else f" in {left:.0f} s"
            what = "stuck" if is_stuck else f"getting stuck{when}"
            return Verdict("STUCK", f"{NAMES[state]}: {what}", self._advice(state, "stuck"), "warned")
        if state == "unknown":
            why, todo = self._unknown()
            return Verdict("UNKNOWN", f"UNKNOWN: {why}", todo, "unknown")
        limit = known.value("Traversability", "LimitingCause")
        probability = known.number("Traversability", "Probability")
        todo = self._advice(state, str(limit))
        if (probability or 0.0) >= self.vehicle.go:
            todo = HELD.get(state, todo)  # nothing limits it: more windows must say the same
        because = [] if limit in (None, "none") else [f"limit: {limit}"]
        because += [] if probability is None else [f"p = {probability:.2f}"]
        return Verdict(NAMES[state], ", ".join((NAMES[state], *because)), todo, state)

    def _advice(self, state: str, cause: str) -> str:
        """Return what to do by state and limiting cause, or `stuck`."""
        said = ADVICE.get((state, cause)) or ADVICE[state, None]
        draft = self.known.number("PresentDemand", "Draft")
        pulls = draft is None or draft > 0.0 or not re.search("draft|lift", said, re.IGNORECASE)
        return said if pulls else UNLADEN[said.startswith("Stop")]

    def _unknown(self) -> tuple[str, str]:
        """Why the state is unknown, and what to do."""
        known = self.known
        if known.has_second_sender:
            return REASONS["foreign_sender"]
        if known.is_stale("Traversability"):
            return "its frames stopped", GONE_ADVICE
        if known.is_unproven:
            return f"waiting for {IN_A_ROW} frames in a row", MEASURING
        reason = str(known.value("SoilbusStatus", "Reason"))
        if known.value("SoilbusStatus", "State") is None:
            return "no status of soilbus", MEASURING
        if known.value("SoilbusStatus", "State") == "starting":
            return "soilbus is starting", MEASURING
        has_no_window = known.number("SoilbusStatus", "Window") is None
        if has_no_window and reason in ("none", "None", "not_excited", "model_gap"):
            return f"the first window takes {self.vehicle.window:g} s", MEASURING
        has_draft = known.is_stale("PresentDemand") or known.number("PresentDemand", "Draft") is not None
        if reason not in REASONS and not has_draft:
            return "no sensor shows the draft", "Go carefully"
        slip = self.slip().value
        if reason == "standstill" and slip is not None and slip >= CARRYING_SLIP:
            # they make no way, so the service calls it a standstill
            return "the wheels spin", self._advice("unknown", "stuck")
        if reason in REASONS:
            return REASONS[reason]
        if known.value("SoilbusStatus", "State") == "estimating":
            return "the next window is due", MEASURING
        return "the estimate is too old", MEASURING

    def slip(self) -> Slip:
        """Return the slip and set-points of the wheel that slips most; unknown axle: the smaller set-points of both."""
        known = [(value, i) for i in range(WHEELS) if (value := self.wheel_slip(i)) is not None]
        if not known:
            return Slip(None, "", *self._set_points(None))
        value, i = max(known, key=lambda pair: pair[0])
        axle = self.vehicle.axles[i] if i < len(self.vehicle.axles) else None
        return Slip(value, self.vehicle.name(i), *self._set_points(axle))

    def _set_points(self, axle: str | None) -> tuple[float | None, float | None]:
        """Slip for efficiency and for pull, while the frame may be acted on."""
        if not self.known.is_valid("TractionAdvice"):
            return None, None
        axles = ("Front", "Rear") if axle is None else (axle,)
        of_kind = (
            [self.known.number("TractionAdvice", f"SlipFor{kind}{name}") for name in axles]
            for kind in ("Efficiency", "Pull")
        )
        best, most_pull = (min((x for x in values if x is not None), default=None) for values in of_kind)
        return best, most_pull

    def wheel_slip(self, wheel: int) -> float | None:
        """Return the slip of a wheel, numbered from 0."""
        return self.known.number("WheelSlip" if wheel < 4 else "WheelSlip2", f"SlipWheel{wheel + 1}")

    def wheel_sinkage(self, wheel: int) -> float | None:
        """Return the sinkage [mm] of a wheel, numbered from 0."""
        return self.known.number("WheelSinkage" if wheel < 4 else "WheelSinkage2", f"SinkageWheel{wheel + 1}")

    def wheels(self) -> list[int]:
        """Return the numbers of the wheels to show: those of the configuration, else four and those with a value."""
        named = len(self.vehicle.wheels) or 4
        values = {i: (self.wheel_slip(i), self.wheel_sinkage(i)) for i in range(WHEELS)}
        return [i for i, of in values.items() if i < named or of != (None, None)]

    def max_draft(self) -> float | None:
        """Return the largest draft [N] here and now, while it may be acted on; 0 where it is stuck without any."""
        most = self.known.number("TractionLimits", "MaxDraft") if self.known.is_valid("TractionLimits") else None
        return None if most is None else max(most, 0.0)

    def drafts(self) -> tuple[str, str]:
        """Return the draft and the largest one in one unit, "-" where not known; a negative draft brakes."""
        now, most = self.known.number("PresentDemand", "Draft"), self.max_draft()
        unit = max(abs(now or 0.0), abs(most or 0.0))
        said, possible = ("-" if x is None else force(x, unit) for x in (now, most))
        return f"braking {said[1:]}" if said.startswith("-") and now is not None else said, possible

    def freshness(self) -> str:
        """Return the age of the data behind the verdict, or that the recording has ended."""
        if self.is_over:
            return "end of the recording"
        age, since = (self.known.number("Traversability", name) for name in ("Age", "SinceValid"))
        more = "over " if self.known.is_at_top("Traversability", "SinceValid") else ""
        said = [] if age is None else [f"data {age:.1f} s old"]
        said += [] if since is None else [f"valid {more}{since:.1f} s ago"]
        return ", ".join(said) or "no estimate"

    def sentences(self) -> list[str]:
        """Return the state, what to do, slip, draft, age, and why the bus is away; each where it is known."""
        verdict, slip, (draft, most) = self.verdict(), self.slip(), self.drafts()
        parts = [verdict.said, verdict.todo]
        if slip.value is not None:
            best = "" if slip.best is None else f", best {percent(slip.best)}"
            parts.append(f"Slip {percent(slip.value)} at wheel {slip.wheel}{best}")
        if draft != "-":
            parts.append(f"Draft {draft}" + ("" if most == "-" else f" of {most}"))
        parts += [] if verdict.kind == "gone" else [self.freshness().capitalize()]
        parts += [f"Bus away: {self.fault}"] if self.fault else []
        return parts


def percent(share: float) -> str:
    """Return a share or a slip in per cent."""
    return f"{round(100.0 * share)} %"


def force(newtons: float, largest: float) -> str:
    """Return a force in kN, or in N where the largest one of its line is below 1 kN."""
    size, digits, unit = (1.0, 0, "N") if abs(largest) < 1000.0 else (1000.0, 1, "kN")
    return f"{round(newtons / size, digits) + 0.0:.{digits}f} {unit}"
