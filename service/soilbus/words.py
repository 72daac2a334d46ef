"""Words of messages: the known name that was probably meant, and an error in one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Such as "; did you mean radius?", or nothing where no known name is near; capitals do not count."""
    folded = {n.casefold(): n for n in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[close[0]]}?" if close else ""


def one_line(error: Exception, most: int | None = None) -> str:
    """What the error says, without line breaks, at most `most` characters of it; its type where it says nothing."""
    return " ".join(str(error).split())[:most] or type(error).__name__
