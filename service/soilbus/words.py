"""A name that is not known -> the known one that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Such as "; did you mean radius?", or nothing where no known name is near; capitals do not count."""
    folded = {n.casefold(): n for n in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[close[0]]}?" if close else ""
