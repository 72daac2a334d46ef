"""A DBC's text without the messages that nobody asks for.

cantools makes some 30 kB of each message, and needs 2 ms for it; a manufacturer's DBC may have
thousands of messages, of which a tractor maps a dozen.  What is not plainly the definition of a
message, or one line about one, stays: then the parser is the judge of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable

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


def message_names(text: str) -> set[str]:
    """Names of the messages that the text defines."""
    return {found["name"] for found in _MESSAGE.finditer(text)}


def of_messages(text: str, names: set[str], also: Callable[[int], bool]) -> str:
    """The text with no messages but those of these names, those that share their identifiers, and `also`.

    `also` is asked with an extended identifier.
    """
    known = [(int(found["id"]), found["name"]) for found in _MESSAGE.finditer(text)]
    wanted = {number for number, name in known if name in names}
    wanted |= {number for number, _ in known if number & _EXTENDED and also(number & ~_EXTENDED)}

    def kept(found: re.Match[str]) -> str:
        return found[0] if int(found["id"]) in wanted else ""

    return _ABOUT.sub(kept, _MESSAGE.sub(kept, text))
