"""Text of a configuration that `soilbus init` proposes: what is matched, what stays open, what nobody can know.

An open value is "?"; `soilbus check` refuses the file with one line for each.  Candidates and what a log says of a
value stand in comments beside it.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import tomlkit
from cantools.database.can import Database, Message

from soilbus.can.channels import WHOLE
from soilbus.can.columns import unit_in
from soilbus.can.mapping import DIMENSIONS, VEHICLE_ROLES
from soilbus.can.role_matching import AXLES, ONLY, WHEELS, Assignment, Candidate, Slot, axles_of, described, is_word_in
from soilbus.can.validity import vouching_codes
from soilbus.config.edit import toml_text
from soilbus.config.faults import OPEN
from soilbus.grouping import grouped
from soilbus.sensors.role_evidence import Facts
from soilbus.words import shown

BEARING_STD_WITHOUT_CELLS = 0.2
"""`estimator.max_bearing_std` [1] for machines without load cells: their windows know the bearing pressure to 10 to
20 % (`soilbus check` says how well)."""
COLUMN = 34
"""Column in which comments beside a value begin."""
MOST_STATE_BITS = 8
"""Length of a signal that can be the state of a drive."""
MOST_LISTED = 4
"""Candidates that one comment lists."""


class Proposal(NamedTuple):
    """Text of a proposed configuration, with the numbers of mapped signals and open values."""

    text: str
    mapped: int
    open: int


@dataclass
class _Draft:
    """What is known of the vehicle, the lines so far, and the signals that they map or name."""

    database: Database
    assignment: Assignment
    facts: Facts
    lines: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    named: set[str] = field(default_factory=set)
    open: int = 0

    def __post_init__(self) -> None:
        self.axles = axles_of(self.assignment)

    def put(self, key: str, value: Any, comment: str = "") -> None:
        """A key of the section, with a comment beside it."""
        line = f"{key} = {tomlkit.item(value).as_string()}"
        self.open += line.count(f'"{OPEN}"')
        self.lines.append(f"{line.ljust(max(len(line) + 2, COLUMN))}# {shown(comment)}" if comment else line)

    def put_open(self, key: str, comment: str) -> None:
        self.put(key, OPEN, comment)

    def put_choice(self, key: str, found: Sequence[Candidate], else_text: str) -> None:
        """An open role with its candidates."""
        self.named.update(c.path for c in found)
        self.put_open(key, _listed(found) or else_text)

    def note(self, *texts: str, apart: bool = False) -> None:
        """A comment for each text, below an empty line where they stand apart."""
        self.lines += [""] * apart + [f"# {shown(text)}" for text in texts]

    def section(self, name: str, repeated: bool = False) -> None:
        """Begin a section, or one more of that name."""
        self.lines += ["", f"[[{name}]]" if repeated else f"[{name}]"]

    def matched(self, role: str, place: str = "") -> Candidate | None:
        return self.assignment.asserted.get(Slot(role, place))

    def put_signal(self, key: str, c: Candidate, **more: str) -> None:
        """The line that maps a role to a signal, with its sign and what vouches for it."""
        self.used.add(c.path)
        message = self.database.get_message_by_name(c.message)
        short = [s.name for s in message.signals if s.length <= MOST_STATE_BITS]
        state = next((name for name in short if is_word_in(name, "state")), "")
        vouching = [s for s in message.signals if s.name != c.signal and s.length <= 2 and is_word_in(s.name, "valid")]
        valid = vouching[0] if len(vouching) == 1 else None
        back = self.facts.backward.get(c.path)
        said = _said_backward(message, c)
        value = tomlkit.inline_table()
        value.update({"signal": c.path, **more} | ({"at": "wheel"} if key == "torque" and _is_at_wheel(c) else {}))
        if valid is not None:
            value["valid"] = valid.name
            if valid.choices:
                value["valid_values"] = list(vouching_codes(valid)) or OPEN
        if back or said:
            value["sign"] = -1
        remarks = [f"negative in {back} in the log"] if back else [f"the DBC: {said}"] if said else []
        if state and c.slot.role == "torque":
            remarks.append(f'does {state} vouch for it? then valid = "{state}", valid_values = [...]')
        if valid is not None and valid.choices and not vouching_codes(valid):
            names = ", ".join(f'{code} "{name}"' for code, name in sorted(valid.choices.items()))
            remarks.append(f"which of {names} vouch for it?")
        remarks += [note for note in c.notes if note == ONLY]
        if c.dimension and c.signal == WHOLE and not c.unit:
            value["unit"] = OPEN
            remarks += [note for note in c.notes if note.endswith("SI")]  # its range
        elif c.signal == WHOLE and c.unit != unit_in(c.message):
            value["unit"] = c.unit
        elif not c.unit and c.dimension:
            remarks.append("no unit in the DBC: SI assumed")
        self.put(key, value if len(value) > 1 else c.path, "; ".join(remarks))


def proposal(
    database: Database, assignment: Assignment, facts: Facts, files: Sequence[str], origin: str, time: str = ""
) -> Proposal:
    """Return a configuration proposed from matched signals and from what a recording says, if there is one.

    DBC files are named as the configuration shall name them; there are none for a table of signals over time, whose
    column of times is `time`. `origin` is the command, for the first line.
    """
    draft = _Draft(database, _one_layout(assignment), facts)
    draft.note(
        f"Proposed by `{origin}`: read each line.",
        f'"{OPEN}" is open: put the value in its place. `soilbus check` names every line that is still open.',
    )
    if files:
        draft.section("bus")
        draft.put("interface", "socketcan")
        draft.put("channel", "can0")
        draft.section("dbc")
        draft.put("input", list(files))
    else:
        draft.section("columns")
        if time:
            draft.put("time", time)
    _put_vehicle(draft)
    axles, driven = _layout_of(draft)
    for axle in axles:
        _put_axle(draft, axle)
    for axle, wheels in draft.axles.items():
        for wheel in wheels:
            _put_wheel(draft, wheel, axle, driven)
    _put_signals(draft)
    _put_rest(draft)
    text = toml_text(tomlkit.parse("\n".join(draft.lines) + "\n"))
    return Proposal(text, len(draft.used), draft.open)


def _one_layout(assignment: Assignment) -> Assignment:
    """Torques of wheels and of axles, or of both axles and of one, are different machines: open unless one is left."""
    places = {slot.place for slot in assignment.asserted if slot.role == "torque"}
    kinds = [places & WHEELS, places & set(AXLES) - {"both"}, places & {"both"}, places & {""}]
    if sum(map(bool, kinds)) <= 1:
        return assignment
    asserted, left = dict(assignment.asserted), dict(assignment.open)
    for slot in assignment.asserted:
        if slot.role in ("torque", "torque_limit", "motor_speed"):
            left[slot] = [asserted.pop(slot)]
    return Assignment(asserted, left, assignment.rivals, assignment.unnamed)


def _layout_of(draft: _Draft) -> tuple[list[str], set[str]]:
    """Axles that have a section, "" for one motor of an unknown axle; places of the torques."""
    asserted = draft.assignment.asserted
    at = {place for role, place in asserted if role == "torque"}
    if not at:  # one open candidate for each axle, or one for the vehicle: motors of axles all the same
        own = {slot.place: cs for slot, cs in draft.assignment.open.items() if slot.role == "torque"}
        if own.keys() <= {"", *AXLES} and all(len(cs) == 1 for cs in own.values()):
            at = set(own)
    if "" in at and draft.facts.axle:
        at = {draft.facts.axle}
    loads = {place for role, place in asserted if role == "load" and place in AXLES}
    if all(draft.matched("load", wheel) for wheels in draft.axles.values() for wheel in wheels):
        loads = set()  # one measurement, not two
    named = set(draft.axles) if len(draft.axles) > 2 else set()
    return [axle for axle in AXLES if axle in at | loads | named] + [""] * ("" in at), at


def _put_vehicle(draft: _Draft) -> None:
    draft.section("vehicle")
    facts = draft.facts
    mass = f"; the loads sum to {facts.mass:.0f} kg in the log" if math.isfinite(facts.mass) else ""
    draft.put_open("mass", f"kg with ballast, tank and driver{mass}")
    ends, share = "front to rear axle", "wheelbase * load of the front axle / weight"
    if len(draft.axles) != 2:
        ends, share = "first to last axle", "sum of each axle's load * its distance to the last one / weight"
    draft.put_open("wheelbase", f"m, {ends}")
    draft.put_open("cg_ahead_of_rear_axle", f"m, centre of gravity: {share}")
    draft.put_open("cg_height", "m, centre of gravity above the ground")
    if draft.matched("draft"):
        draft.put_open("hitch_height", "m, line of draft above the ground")
    else:
        draft.put_open("towing", '"never", "unknown", or "measured" with signals.draft mapped')
    if draft.matched("yaw_rate"):
        draft.note("track = 1.5  # m, left to right wheel: turns the yaw rate into a difference of speeds")
    if lock := draft.matched("differential_lock"):
        draft.put_signal("differential_lock", lock)


def _put_axle(draft: _Draft, axle: str) -> None:
    draft.section("axle", repeated=True)
    place = axle
    if axle:
        draft.put("name", axle)
    else:
        names = ", ".join(f'"{name}"' for name in draft.axles)
        draft.put_open("name", f'axle that this motor drives: {names} or "both"')
    if axle in [*draft.axles][1:-1]:
        draft.note("ahead_of_rear_axle = 1.0  # m, to the last axle; without, all axles are equally far apart")
    if axle == "" or (axle == draft.facts.axle and not draft.matched("torque", axle)):
        place = ""  # the motor of no name
        if axle:
            draft.note("the motor turns with this axle's wheels in the log")
    known = draft.matched("torque", place)
    if torque := known or next(iter(draft.assignment.open.get(Slot("torque", place), [])), None):
        speed = _beside(draft, torque, draft.matched("motor_speed", place))
        if speed is not None or not _is_at_wheel(torque):
            _put_gear(draft, axle)
        draft.put_open("differential", '"open", "locked" or "limited"')
        if known is not None:
            draft.put_signal("torque", torque)
        else:
            draft.put_choice("torque", [torque], "")
        _put_limit(draft, torque, "axle")
        if speed is not None:
            draft.put_signal("motor_speed", speed)
    if axle and (load := draft.matched("load", axle)):
        draft.put_signal("load", load)


def _put_wheel(draft: _Draft, wheel: str, axle: str, driven: set[str]) -> None:
    draft.section("wheel", repeated=True)
    draft.put("name", wheel)
    draft.put("axle", axle)
    radius = draft.facts.radius.get(wheel)
    seen = f"; radius * (1 - slip) is {radius:.2f} in the log" if radius else ""
    draft.put_open("radius", f"m, rolling radius{seen}")
    draft.put_open("width", "m, of the tyre")
    torque, speed = draft.matched("torque", wheel), draft.matched("speed", wheel)
    motor = draft.matched("motor_speed", wheel)
    by_axle = bool(driven & {axle, "both"})
    if motor is not None or (torque is not None and not _is_at_wheel(torque)):
        _put_gear(draft, wheel)
    if torque is not None:
        draft.put_signal("torque", torque)
        _put_limit(draft, torque, "wheel")
    elif not by_axle and driven:
        draft.put_open("driven", "true or false: no torque of it was found")
    elif not by_axle:
        known = _of_role(draft, "torque", wheel)
        draft.put_choice("torque", known, '"Message.Signal" of its motor, here or in [[axle]]')
        if motor is None:
            _put_gear(draft, wheel)
    if speed is not None:
        draft.put_signal("speed", speed)
        if motor is not None:
            draft.put_signal("motor_speed", motor)
    elif motor is not None:
        draft.put_signal("speed", motor, at="shaft")
    elif not (by_axle and any(draft.matched("motor_speed", a) for a in (axle, "both", ""))):
        draft.put_choice("speed", _of_role(draft, "speed", wheel), '"Message.Signal" of its rotation')
    for role in ("load", "sinkage"):
        if c := draft.matched(role, wheel):
            draft.put_signal(role, c)


def _put_gear(draft: _Draft, place: str) -> None:
    if (ratio := draft.facts.gear_ratio.get(place)) is not None:
        short = float(f"{ratio:.3g}")
        rounded = short if abs(short / ratio - 1.0) < ROUNDING else float(f"{ratio:.4g}")
        draft.put("gear_ratio", rounded, "motor over wheel speed in the log")
        return
    per_metre = draft.facts.per_metre.get(place)
    text = "motor shaft to wheel; 1.0 where torque is measured at the wheel"
    if place in ("both", ""):
        text += "; of both axles: to their shafts, where [[axle]] front and rear have ratios of their own"
    draft.put_open("gear_ratio", f"{text}; {per_metre:.4g} * radius by the log" if per_metre else text)


def _put_limit(draft: _Draft, torque: Candidate, at: str) -> None:
    if limit := _beside(draft, torque, draft.matched("torque_limit", torque.slot.place)):
        draft.put_signal("torque_limit", limit)
    else:
        draft.note(f"max_torque = 5000.0  # N m at the {at}: the motor's limit")


def _beside(draft: _Draft, torque: Candidate, c: Candidate | None) -> Candidate | None:
    """A signal that belongs to a torque: of its place or, where no name says a place, of its message or sender."""
    if c is None or torque.slot.place or c.message == torque.message or c.signal == WHOLE:
        return c
    one, other = (draft.database.get_message_by_name(name).senders for name in (c.message, torque.message))
    return c if set(one) & set(other) - {"Vector__XXX"} else None


def _is_at_wheel(torque: Candidate) -> bool:
    return is_word_in(torque, "wheel") and not is_word_in(torque, "motor", "shaft")


def _put_signals(draft: _Draft) -> None:
    draft.section("signals")
    draft.note("positive: ground speed and torque forward, draft backward, pitch nose up, yaw left, roll left side up")
    for role in VEHICLE_ROLES:
        c = draft.matched(role)
        if c is not None:
            kind = draft.facts.kind or _kind_by_words(draft.database, c) if role == "acceleration" else "kinematic"
            draft.put_signal(role, c, **({} if kind == "kinematic" else {"kind": kind or OPEN}))
            if not kind:
                draft.note('kind: "kinematic" is dv/dt, "specific_force" what an inertial sensor feels, slope included')
        elif role == "ground_speed":
            known = _of_role(draft, role)
            draft.put_choice(role, known, '"Message.Signal" of a radar or receiver, not of the wheels')


def _put_rest(draft: _Draft) -> None:
    """Limits without load cells, noise, and candidates that no line names."""
    wheels = [wheel for pair in draft.axles.values() for wheel in pair]
    if not any(all(draft.matched("load", place) for place in places) for places in (wheels, draft.axles)):
        draft.section("estimator")
        why = "a window without load cells knows the bearing pressure to 10 to 20 %"
        draft.put("max_bearing_std", BEARING_STD_WITHOUT_CELLS, why)
    noise = "[noise]: sd of each sensor, from data sheets or a drive on the road; else the defaults hold"
    draft.note(noise, apart=True)
    known = draft.assignment
    found = [*(c for cs in known.open.values() for c in cs), *known.asserted.values(), *known.rivals]
    rest = {c.path: c for c in found if c.path not in draft.used | draft.named}
    if perhaps := grouped((c for c in rest.values() if not c.absent), lambda c: c.slot.role):
        draft.note("Not used, but perhaps:", *(f"  {role}: {_listed(cs)}" for role, cs in perhaps.items()), apart=True)
    loose = [c for c in known.unnamed if c.path not in draft.used | draft.named and not c.absent]
    if unnamed := grouped(loose, lambda c: c.dimension):
        lines = (f"  {dimension}: {_listed(cs)}" for dimension, cs in unnamed.items())
        draft.note("Of no role that a name says; by their units:", *lines, apart=True)
    if absent := sorted(path for path, c in rest.items() if c.absent):
        lines = (f"  {line}" for line in textwrap.wrap(", ".join(absent), 116, break_long_words=False))
        draft.note("In the DBC, but never in the log:", *lines, apart=True)


def _of_role(draft: _Draft, role: str, place: str = "") -> list[Candidate]:
    """Candidates of an open slot, else those of the role wherever they are, else what has a unit of it there."""
    own = draft.assignment.open.get(Slot(role, place))
    anywhere = (c for slot, cs in draft.assignment.open.items() if slot.role == role for c in cs)
    loose = (c for slot, c in draft.assignment.asserted.items() if slot.role == role and not slot.place)
    named = own or sorted([*anywhere, *loose], key=lambda c: -c.score)
    fitting = DIMENSIONS[role]
    return named or [c for c in draft.assignment.unnamed if c.slot.place == place and c.dimension in fitting]


def _listed(found: Iterable[Candidate]) -> str:
    known = list(found)
    more = f", and {len(known) - MOST_LISTED} more" if len(known) > MOST_LISTED else ""
    return ", ".join(described(c) for c in known[:MOST_LISTED]) + more


def _kind_by_words(database: Database, c: Candidate) -> str:
    comment = (database.get_message_by_name(c.message).get_signal_by_name(c.signal).comment or "").casefold()
    if "without gravity" in comment:
        return "kinematic"
    is_force = is_word_in(c, "force", "specific") or "specific force" in comment
    return "specific_force" if is_force else ""


_OTHER_WAY: Mapping[str, str] = {
    "yaw_rate": r"(?:to the )?right|clockwise|(?:to )?starboard", "steering_angle": r"(?:to the )?right|clockwise",
    "roll": r"right side up|left side down", "pitch": r"(?:nose|bow) down", "acceleration": r"backward|rearward",
    "draft": r"forward", "ground_speed": r"backward", "sinkage": r"up",
}  # fmt: skip
"""What a comment says after "positive" where a signal reads the other way round than its role."""


def _said_backward(message: Message, c: Candidate) -> str:
    """The words of a comment by which the signal needs sign = -1; "" without."""
    comment = message.get_signal_by_name(c.signal).comment or ""
    pattern = rf"positive (?:{_OTHER_WAY.get(c.slot.role, '(?!)')})\b"
    return found[0] if (found := re.search(pattern, comment, re.IGNORECASE)) else ""


ROUNDING = 0.001
"""Relative change by which a measured gear ratio may be rounded: gain errors of two speed sensors."""
