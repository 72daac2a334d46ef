"""Signals of a vehicle's DBC matched to roles of the configuration, by unit, name, comment and range.

    score(signal, role) = base of the unit + sum over words of weight * share(where the word stands)
    assignment          = argmax of the sum of scores, each signal and each slot at most once

A slot is a role at a place ("torque" at "FL", "load" at "rear", "draft").  A match is asserted where its score reaches
ASSERTED and beats the next free candidate of its slot by MARGIN; anything else stays open and lists its candidates.
The weights are judgement, held by the roles right, wrong and open on the DBCs of tests/proposal.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database, Message, Signal

from soilbus.can.channels import WHOLE, path_of
from soilbus.can.j1939 import pgn_of
from soilbus.can.mapping import DIMENSIONS
from soilbus.can.units import Unit, unit_of

_LETTERS = {"front": "F", "middle": "M", "rear": "R", **{str(k): str(k) for k in range(1, 5)}}
"""Letter of the wheels of each axle, front to rear; four axles have numbers."""
AXLES = (*_LETTERS, "both")  # places of axles; `both` for one motor that drives all of them
WHEELS = frozenset(letter + side for letter in _LETTERS.values() for side in "LR")
ASSERTED = 1.0  # score from which a match is asserted: the unit fits and a strong word of the role stands in a name
MARGIN = 0.3  # score by which it must beat the next candidate: less than one word
LISTED = 0.25  # score from which a candidate is worth a line
SOLE = 0.5  # score from which the only candidate of a slot is taken: half of what an asserted match needs
ONLY = "the only candidate"  # note on a match that was taken because there is no other
NEEDS = "with "  # begin of a note on a number that the DBC does not have
IN_MESSAGE, IN_COMMENT = 0.7, 0.5
"""Share of a word's weight where it stands in the message's name or in the comment, not in the signal's own name."""
HINT = 0.25  # the same of a word against a role, where the signal's own name speaks for it

_SPELLINGS: Mapping[str, str] = {
    "torque": "tq trq trque torq moment mom drehmoment drehmom",
    "speed": "spd vel velocity rpm sog revolution wss drehzahl drehz geschwindigkeit geschw"
    " raddrehzahl raddrehz raddrehzahlen",
    "motor": "mot mtr mcu inv inverter emotor drv asm psm antrieb", "shaft": "rotor",
    "wheel": "whl wh tyre tire wss raddrehzahl raddrehz raddrehzahlen radlast radlasten",
    "axle": "axl achse achslast achslasten",
    "load": "ld wgt wght weight fz scale radlast radlasten achslast achslasten", "draft": "drft draught dft zugkraft",
    "pull": "tow traction drawbar", "hitch": "htch linkage implement impl pin",
    "ground": "gnd radar gps gnss sog doppler overground", "sinkage": "sink rut", "height": "hgt ride",
    "pitch": "ptch nick nickwinkel", "slope": "grade inclination incline neigung", "roll": "bank wank wankwinkel",
    "yaw": "gz gier gierrate", "rate": "rt gierrate",
    "acceleration": "acc accel accelerometer beschleunigung beschl laengsbeschl querbeschl",
    "longitudinal": "lgt lon long along forward x ax laengs laengsbeschl", "lateral": "lat y ay quer querbeschl",
    "vertical": "vert z az", "steering": "steer str eps mdps lenk lenkwinkel",
    "angle": "ang winkel lenkwinkel nickwinkel wankwinkel", "force": "frc kraft", "relative": "rel",
    "latitude": "lat", "longitude": "lon long lng", "position": "pos gps gnss", "differential": "diff",
    "lock": "locked lck", "limit": "lim max maximum avail available avl greatest", "least": "min minimum",
    "request": "req requested cmd command commanded demand dmd setpoint setpt sp target tgt desired des ref reference"
    " soll sollwert",
    "actual": "act fbk feedback fb measured meas estimated est real ist istwert", "pto": "powertakeoff",
    "engine": "eng ice", "brake": "brk braking", "vehicle": "veh machine motion", "odometer": "odo",
    "valid": "ok qualifier vld", "state": "status stat zustand", "current": "curr cur amps iq",
    "front": "frnt frt fnt fwd vorn vorne", "middle": "mid mitte", "rear": "re rer back hind hinten",
    "left": "lft lh links", "right": "rght rgt rh rechts",
}  # fmt: skip
"""Abbreviations, synonyms and German words of each word."""
_OTHER = (
    "force specific hand column pump fan cruise gravity course cog fraction coverage distance direction travel steady"
    " temperature voltage counter checksum percent rated loss friction north east up down link lift position"
)
_WORDS: dict[str, frozenset[str]] = {}
for _word, _short in (dict.fromkeys(_OTHER.split(), "") | {**_SPELLINGS}).items():
    for _spelling in (_word, *_short.split()):
        _WORDS[_spelling] = _WORDS.get(_spelling, frozenset()) | {_word}

_CORNERS = {"fl": "FL", "lf": "FL", "fr": "FR", "rf": "FR", "rl": "RL", "lr": "RL", "rr": "RR"} | {
    "vl": "FL", "vr": "FR", "hl": "RL", "hr": "RR", "ml": "ML", "mr": "MR"
}  # fmt: skip
_NUMBERED = {pair: k + side.upper() for k in "1234" for side in "lr" for pair in (k + side, side + k)}
_AXLE_LETTERS = {"f": ("r", "front"), "r": ("f", "rear"), "v": ("h", "front"), "h": ("v", "rear")}
"""Letter of an axle: its counterpart, and the axle."""
_GROUPS: Mapping[int, frozenset[str]] = {
    65093: frozenset({"draft", "rear"}), 65094: frozenset({"draft", "front"}), 65096: frozenset({"wheel"}),
    65097: frozenset({"ground"}), 65265: frozenset({"wheel"}), 65267: frozenset({"position"}),
    127251: frozenset({"yaw"}), 129025: frozenset({"position"}),
}  # fmt: skip
"""What the standards say of a parameter group, with any names of its signals."""
_ASKED = frozenset({"request", "least", "rated"})
_HITCH = frozenset({"hitch", "draft", "pull", "link"})
_OTHER_MACHINES = frozenset({"pto", "engine", "brake", "pump", "fan", "steering"})
_ROLES: Mapping[str, tuple[float, Mapping[str, float], frozenset[str]]] = {
    "torque": (0.6, {"motor": 0.4, "shaft": 0.2, "wheel": 0.2, "axle": 0.2, "torque": 0.3, "actual": 0.4},
        _ASKED | _OTHER_MACHINES | {"limit", "loss", "friction", "lock", "differential"}),
    "torque_limit": (0.0, {"limit": 1.2}, _ASKED | _OTHER_MACHINES),
    "motor_speed": (0.3, {"motor": 0.7, "shaft": 0.5, "speed": 0.2, "actual": 0.2},
        _ASKED | _OTHER_MACHINES | {"wheel", "yaw", "roll", "pitch", "limit", "relative"}),
    "speed": (0.1, {"wheel": 0.8, "speed": 0.2},
        _ASKED | _OTHER_MACHINES | {"motor", "shaft", "limit", "yaw", "ground", "relative", "load", "torque"}),
    "load": (0.2, {"load": 0.8, "wheel": 0.3, "axle": 0.3, "vertical": 0.4},
        _ASKED | {"draft", "hitch", "pull", "lateral", "limit", "link"}),
    "sinkage": (0.0, {"sinkage": 1.2, "height": 0.3}, _ASKED | {"distance", "travel", "hitch", "limit"}),
    "ground_speed": (0.1, {"ground": 0.85, "speed": 0.3, "vehicle": 0.1},
        _ASKED | {"wheel", "axle", "odometer", "cruise", "limit", "lateral", "vertical", "north", "east", "motor",
         "coverage", "relative"}),
    "draft": (0.1, {"draft": 1.0, "pull": 0.6, "hitch": 0.3, "force": 0.1},
        _ASKED | {"lateral", "vertical", "wheel", "axle", "limit", "lift", "front"}),
    "pitch": (0.1, {"pitch": 1.0, "slope": 0.6, "longitudinal": 0.4},
        _ASKED | {"rate", "roll", "lateral", "steering", "hitch"}),
    "roll": (0.1, {"roll": 1.0, "slope": 0.6, "lateral": 0.4},
        _ASKED | {"rate", "pitch", "longitudinal", "steering", "hitch"}),
    "yaw_rate": (0.1, {"yaw": 1.0, "rate": 0.2},
        _ASKED | {"pitch", "roll", "motor", "shaft", "wheel", "longitudinal", "lateral", "acceleration"}),
    "acceleration": (0.2, {"longitudinal": 0.9, "acceleration": 0.3, "specific": 0.6, "force": 0.3},
        _ASKED | {"lateral", "vertical", "limit"}),
    "steering_angle": (0.1, {"steering": 0.8, "angle": 0.2, "front": 0.3},
        _ASKED | {"hand", "column", "rate", "limit", "fraction"}),
    "latitude": (0.1, {"latitude": 0.8, "position": 0.4}, frozenset({"slope", "acceleration", "pitch"})),
    "longitude": (0.1, {"longitude": 0.8, "position": 0.4}, frozenset({"slope", "acceleration", "pitch"})),
    "differential_lock": (0.0, {"differential": 0.6, "lock": 0.6}, _ASKED),
}  # fmt: skip
"""Of each role: score of a fitting unit, weights of words, words that speak against it."""
FEWEST_BITS = 7  # length of the shortest signal that measures anything; shorter ones are codes and flags
COARSEST_POSITION = 2e-5  # resolution [rad] up to which a signal alone can be a latitude: 130 m
_AGAINST = 1.5  # score that a word against a role costs
_NO_UNIT = 0.4  # score that a missing unit costs
WHEEL_AND_AXLE = frozenset({"torque", "torque_limit", "motor_speed", "load"})
WHEEL_ONLY = frozenset({"speed", "sinkage"})
UNIT_ALONE = ""  # in the place of a role: a signal whose unit is one of ours, and whose name says nothing


class Slot(NamedTuple):
    """Role with its wheel or axle; "" for the whole vehicle, or where the place is not known."""

    role: str
    place: str


@dataclass(frozen=True, slots=True)
class Candidate:
    """Signal as a candidate for one slot: its score, and what speaks against it."""

    slot: Slot
    message: str
    signal: str
    score: float
    unit: str
    factor: float  # SI value of one unit of the DBC; 1 without a unit
    dimension: str
    notes: tuple[str, ...] = ()
    absent: bool = False  # whether a log has no value of it

    @property
    def path(self) -> str:
        """`Message.Signal`, or the name of a column."""
        return path_of(self.message, self.signal)

    def changed(self, by: float, note: str = "") -> Candidate:
        """Return the candidate with another score and a note on why."""
        return replace(self, score=self.score + by, notes=(*self.notes, note) if note else self.notes)


@dataclass(frozen=True, slots=True)
class Assignment:
    """Asserted signals by slot, candidates of open slots, rivals of asserted ones, signals with only a unit."""

    asserted: dict[Slot, Candidate] = field(default_factory=dict)
    open: dict[Slot, list[Candidate]] = field(default_factory=dict)
    rivals: list[Candidate] = field(default_factory=list)
    unnamed: list[Candidate] = field(default_factory=list)


def candidates(database: Database) -> list[Candidate]:
    """Return every signal of the vehicle's bus for every slot that it may fill, with a score from LISTED up.

    A signal that may fill none, but has a unit of ours, is one of UNIT_ALONE with score 0.
    """
    names = frozenset(name for m in database.messages for name in (m.name, *(s.name for s in m.signals)))
    said = {place for m in database.messages for s in m.signals for text in _texts(m, s) if (place := _place(text))}
    known = _known_places(said)
    return [c for m in database.messages for s in m.signals for c in _of_signal(m, s, names, known)]


def axles_of(assignment: Assignment) -> dict[str, tuple[str, str]]:
    """Return the names of an assignment's axles, front to rear, with the left and the right wheel."""
    letters = {slot.place[:1] for slot in (*assignment.asserted, *assignment.open)}
    numbers = [name for name in _LETTERS if name.isdigit()]
    three = ("front", "middle", "rear") if letters & {"M", "m"} else ("front", "rear")
    return {name: (_LETTERS[name] + "L", _LETTERS[name] + "R") for name in (numbers if letters & {*numbers} else three)}


def assigned(found: Iterable[Candidate]) -> Assignment:
    """Assign each signal to one slot by the largest sum of scores; what is not clear stays open.

    At last the one candidate of a slot and of no other is asserted, where its place and its torque are known.
    """
    from scipy.optimize import linear_sum_assignment

    best: dict[tuple[Slot, str], Candidate] = {}
    out = Assignment()
    for c in found:
        if c.slot.role == UNIT_ALONE:
            out.unnamed.append(c)
        known = best.get((c.slot, c.path))
        if c.score >= LISTED and (known is None or c.score > known.score):
            best[c.slot, c.path] = c
    slots = sorted({slot for slot, _ in best})
    paths = sorted({path for _, path in best})
    score = np.zeros((len(slots), len(paths)))
    for (slot, path), c in best.items():
        score[slots.index(slot), paths.index(path)] = c.score * (c.score >= ASSERTED)
    taken = {(slots[i], paths[j]) for i, j in zip(*linear_sum_assignment(-score), strict=True) if score[i, j] > 0.0}
    for slot in slots:
        elsewhere = {path for other, path in taken if other != slot}
        of_slot = [c for (s, path), c in best.items() if s == slot and path not in elsewhere]
        of_slot.sort(key=lambda c: -c.score)
        chosen = next((c for c in of_slot if (slot, c.path) in taken), None)
        rivals = [c for c in of_slot if c is not chosen]
        if chosen is not None and all(chosen.score - c.score >= MARGIN for c in rivals):
            out.asserted[slot] = chosen
            out.rivals.extend(c for c in rivals if c.score >= ASSERTED)
        elif of_slot:
            out.open[slot] = of_slot
    uses = Counter(c.path for cs in out.open.values() for c in cs)
    for slot, (first, *others) in list(out.open.items()):
        is_whole = slot.role not in WHEEL_ONLY | WHEEL_AND_AXLE or slot.place
        is_known = not first.absent and not any(note.startswith(NEEDS) for note in first.notes)
        if is_whole and is_known and not others and uses[first.path] == 1 and first.score >= SOLE:
            out.asserted[slot] = first.changed(0.0, ONLY)
            del out.open[slot]
    return out


def described(candidate: Candidate) -> str:
    """Return a candidate for a comment: path, unit and what speaks against it."""
    said = [candidate.unit] * bool(candidate.unit) + list(candidate.notes)
    return f"{candidate.path} ({', '.join(said)})" if said else candidate.path


def is_word_in(name: Candidate | str, *words: str) -> bool:
    """Return whether the name of a signal, or of a candidate and its message, has one of these words."""
    texts = (name,) if isinstance(name, str) else (name.signal, name.message)
    return any(word in _words(text) for text in texts for word in words)


# --- one signal ---


def _texts(message: Message, signal: Signal) -> tuple[str, ...]:
    return signal.name, message.name, *(message.senders or ()), signal.comment or ""


def _known_places(said: set[str]) -> dict[str, str]:
    """The place that each spelling means in a DBC: M where it has F, M and R, numbers where it has 1 to 3 or 1 to 4."""
    six = [{letter + side for letter in "FMR" for side in "LR"}, {"front", "middle", "rear"}]
    known = {place: place for place in said if place[0].casefold() != "m" or any(places <= said for places in six)}
    numbers = {place[0] for place in said if place[0].isdigit()}
    names = {3: ("front", "middle", "rear"), 4: ("1", "2", "3", "4")}.get(len(numbers), ())
    meant = dict(zip("1234", names, strict=False)) if numbers == set("1234"[: len(names)]) else {}
    for place in said:
        if place[0].isdigit():
            name = meant.get(place[0], "")
            known[place] = _LETTERS[name] + place[1] if name and place[1:] else name
    return known


def _of_signal(message: Message, signal: Signal, names: frozenset[str], known: Mapping[str, str]) -> list[Candidate]:
    places = (known.get(_place(text)) or _axle_by_letter(text, names) for text in _texts(message, signal))
    place = next(filter(None, places), "")
    try:
        unit = unit_of(signal.unit)
    except ValueError:
        return _indirect(message, signal, place)
    group = pgn_of(message.frame_id) if message.is_extended_frame else 0
    own, around = _words(_own_name(message, signal)), _words(message.name) | _GROUPS.get(group, frozenset())
    if signal.name == WHOLE:
        around = own
    comment = _words(signal.comment or "")
    found = []
    for role in _ROLES:
        dimensions = DIMENSIONS[role]
        if unit is not None and unit.dimension not in dimensions:
            continue
        if signal.length < FEWEST_BITS and dimensions != ("",):
            continue
        at_wheel = place in WHEELS
        score = _score(role, own, around, comment, unit is not None, at_wheel) + _by_range(role, signal, unit, own)
        slot = Slot(role, place if role in WHEEL_AND_AXLE or (role in WHEEL_ONLY and at_wheel) else "")
        notes: tuple[str, ...] = ("no unit: SI assumed",) if unit is None and dimensions != ("",) else ()
        if role in WHEEL_ONLY and slot.place not in WHEELS:
            notes += ("not of one wheel",)
        if score >= LISTED:
            found.append(_candidate(slot, message, signal, score, unit or Unit(dimensions[0], 1.0), notes))
    if not found and unit is not None and signal.length >= FEWEST_BITS and not own & (_ASKED | _OTHER_MACHINES):
        notes = ("relative to another",) if "relative" in own else ()
        found.append(_candidate(Slot(UNIT_ALONE, place), message, signal, 0.0, unit, notes))
    return found


def _candidate(
    slot: Slot, message: Message, signal: Signal, score: float, unit: Unit, notes: tuple[str, ...]
) -> Candidate:
    return Candidate(slot, message.name, signal.name, score, signal.unit or "", unit.factor, unit.dimension, notes)


def _indirect(message: Message, signal: Signal, place: str) -> list[Candidate]:
    """A percentage or a current, which is a torque with a number that the DBC does not have: never asserted."""
    own, around, unit = _words(_own_name(message, signal)), _words(message.name), (signal.unit or "").strip()
    if unit == "%" and "torque" in own:
        number = "reference_torque"
    elif unit in ("A", "mA", "kA") and "current" in own and "motor" in own | around:
        number = "torque_constant"
    else:
        return []
    if own & _ASKED or "limit" in own:
        return []
    score, notes = (LISTED + ASSERTED) / 2.0, (NEEDS + number,)
    return [_candidate(Slot("torque", place), message, signal, score, Unit("torque", 1.0), notes)]


def _own_name(message: Message, signal: Signal) -> str:
    """The name of a signal, or of a column without its unit."""
    return message.name.removesuffix(f"[{signal.unit}]") if signal.name == WHOLE else signal.name


def _score(
    role: str, own: frozenset[str], around: frozenset[str], comment: frozenset[str], has_unit: bool, at_wheel: bool
) -> float:
    base, weights, against = _ROLES[role]
    if at_wheel:
        against = against - _HITCH  # a load pin is in a wheel's hub, too
        around = around | {"wheel"} if role == "speed" else around
    is_bare = not own - {"front", "middle", "rear", "speed"}  # it only says where, or how fast: the message says what
    score = base if has_unit or DIMENSIONS[role] == ("",) else -_NO_UNIT
    for word, weight in weights.items():
        share = 1.0 if word in own else (1.0 if is_bare else IN_MESSAGE) if word in around else 0.0
        score += weight * max(share, IN_COMMENT if word in comment else 0.0)
    for word in against:
        if word in own:
            score -= _AGAINST
        elif word in around:
            is_hint = own & weights.keys() and word not in _ASKED
            score -= _AGAINST * (HINT if is_hint else IN_MESSAGE)
        elif word in comment & _ASKED:
            score -= _AGAINST * HINT
    return score


def _by_range(role: str, signal: Signal, unit: Unit | None, own: frozenset[str]) -> float:
    """What the range of the DBC, in SI, adds to a score."""
    factor = unit.factor if unit else 1.0
    low, high = (math.nan if end is None else float(end) * factor for end in (signal.minimum, signal.maximum))
    extent = max(abs(low), abs(high)) if math.isfinite(low) and math.isfinite(high) else math.nan
    if role == "steering_angle":
        # the hand wheel turns further, and is what "steering angle" means on a car
        return -1.0 if extent > 1.6 or {"steering", "wheel"} <= own else 0.0 if extent > 0.0 else -0.3
    if role in ("latitude", "longitude"):
        least = (math.pi / 2.0 if role == "latitude" else math.pi) - 1e-6
        is_coarse = not signal.conversion.is_float and float(signal.scale) * factor > COARSEST_POSITION
        return -1.0 if extent < least or low >= 0.0 or is_coarse else 0.0  # its minutes stand elsewhere
    if role in ("pitch", "roll"):
        return -1.0 if extent > 2.0 * math.pi - 0.1 or low >= 0.0 else 0.0  # a course
    if role in ("torque", "draft", "acceleration", "yaw_rate") and low >= 0.0:
        return -0.2 if role == "torque" else -0.1  # braking or pushing cannot be said
    if role == "torque_limit" and low < 0.0 and high <= 0.0:
        return -2.0  # of the generator
    return 0.0


# --- words ---


PIECE = r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+"  # names are parted at underscores, capitals and digits


@cache
def _tokens(text: str) -> tuple[str, ...]:
    """Pieces of a name: at underscores, capitals and digits, and whole words run together."""
    small = [piece.casefold() for piece in re.findall(PIECE, text)]
    singular = (p[:-1] if p not in _WORDS and p[:-1] in _WORDS and p.endswith("s") else p for p in small)
    return tuple(part for piece in singular for part in _parted(piece))


def _parted(piece: str) -> tuple[str, ...]:
    """A piece as known words, where it is made of nothing else ("wheelspeed", "whlspdfl")."""
    if piece in _WORDS or piece in _CORNERS or len(piece) < 5:
        return (piece,)
    for n in range(len(piece) - 2, 1, -1):
        head, rest = piece[:n], piece[n:]
        if (head in _WORDS and n > 2) or head in _CORNERS:
            parts = _parted(rest)
            if all(p in _WORDS or p in _CORNERS for p in parts):
                return (head, *parts)
    return (piece,)


def _axle_by_letter(text: str, names: frozenset[str]) -> str:
    """front or rear by a letter of its own ("MCU_F_Tq"), where the DBC has the other axle's name, too."""
    found = set()
    for letter in re.finditer(PIECE, text):
        other, axle = _AXLE_LETTERS.get(letter[0].casefold(), ("", ""))
        other = other.upper() if letter[0].isupper() else other
        if other and text[: letter.start()] + other + text[letter.end() :] in names:
            found.add(axle)
    return min(found) if len(found) == 1 else ""


def _words(text: str) -> frozenset[str]:
    """What a text speaks of, places left out but for front, which says which wheels steer."""
    found = frozenset[str]().union(*(_WORDS.get(token, frozenset()) for token in _tokens(text)))
    return found - {"left", "right"}


def _place(text: str) -> str:
    """FL to RR, 1L to 4R; front, middle, rear, 1 to 4, both; or "" where a text says no place, or several."""
    tokens = _tokens(text)
    along = {w for t in tokens for w in _WORDS.get(t, ()) if w in ("front", "middle", "rear")}
    across = {w for t in tokens for w in _WORDS.get(t, ()) if w in ("left", "right")}
    if not along:  # "FrLft", "RrAxl"
        axles = {here for here, following in pairwise(tokens) if "axle" in _WORDS.get(following, ())}
        along = {_AXLE_LETTERS[t[0]][1] for t in (tokens if across else axles) if t in ("fr", "rr")}
    beside = [(a, b) for pair in pairwise(tokens) for a, b in (pair, pair[::-1]) if "axle" in _WORDS.get(a, ())]
    along = along or {number for _, number in beside if number in _LETTERS}
    if len(along) == len(across) == 1:
        return _LETTERS[min(along)] + {"left": "L", "right": "R"}[min(across)]
    letters = [a + b for a, b in pairwise(tokens) if len(a) == len(b) == 1]
    corners = {_CORNERS[t] for t in (*tokens, *letters) if t in _CORNERS}
    corners = corners or {_NUMBERED[pair] for pair in letters if pair in _NUMBERED}
    if len(corners) == 1 and not along and not across:
        return min(corners)
    if corners or across:
        return ""
    if "both" in tokens or len(along) == 2:
        return "both"
    return min(along) if along else ""
