"""A DBC's text without the messages that nobody asks for, checked for ranges that no memory can hold.

cantools needs 30 kB and 2 ms for a message; a maker's DBC may have thousands, of which a tractor maps a dozen.  What is
not plainly the definition of a message, or one line about one, stays: the parser is the judge of it.
"""

from __future__ import annotations

import re

from soilbus.can.j1939 import STANDARD_PGNS, pgn_of

_EXTENDED = 1 << 31
_MESSAGE = re.compile(
    r"""^BO_[ \t]+(?P<id>\d+)[ \t]+(?P<name>\w+)[ \t]*:[^"\n]*\n"""
    r"""(?:[ \t]+SG_[ \t][^"\n]*"[^"\n]*"[^"\n]*\n)*""",
    re.MULTILINE,
)
_ABOUT = re.compile(
    r"""^(?:(?:CM_|BA_[ \t]+"[^"\n]*")[ \t]+(?:BO_|SG_)|VAL_|BO_TX_BU_|SIG_GROUP_|SIG_VALTYPE_|SG_MUL_VAL_)"""
    r"""[ \t]+(?P<id>\d+)\b[^"\n]*(?:"[^"\n]*"[^"\n]*)*;[ \t\r]*\n""",
    re.MULTILINE,
)

MOST_MULTIPLEXER_VALUES = 1 << 18
"""Values of all ranges of a DBC: 1024 signals in each of 256 pages.  cantools makes 0.3 kB of each."""
MOST_DIGITS = 12  # digits of a number in a range: a multiplexer of 32 bits has 10
_RANGES = re.compile(r"\bSG_MUL_VAL_\s+\d+\s+(?P<signal>\w+)\s+\w+(?P<ranges>[^;]*)")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")


def check_multiplexers(text: str) -> None:
    """Raise ValueError where the ranges of SG_MUL_VAL_ have too many values for the parser to expand."""
    left = MOST_MULTIPLEXER_VALUES
    for found in _RANGES.finditer(text):
        for low, high in _RANGE.findall(found["ranges"]):
            left -= max(int(high) - int(low) + 1, 0) if len(high) < MOST_DIGITS else left + 1
            if left < 0:
                raise ValueError(
                    f"SG_MUL_VAL_ of {found['signal']}: with {low}-{high} the multiplexers have more than"
                    f" {MOST_MULTIPLEXER_VALUES} values"
                )


def of_messages(text: str, names: set[str]) -> str:
    """Return the DBC's text with these messages, those of their identifiers, and those of the standards' groups."""
    known = [(int(found["id"]), found["name"]) for found in _MESSAGE.finditer(text)]
    wanted = {number for number, name in known if name in names}
    wanted |= {number for number, _ in known if number & _EXTENDED and pgn_of(number & ~_EXTENDED) in STANDARD_PGNS}

    def kept(found: re.Match[str]) -> str:
        return found[0] if int(found["id"]) in wanted else ""

    return _ABOUT.sub(kept, _MESSAGE.sub(kept, text))
