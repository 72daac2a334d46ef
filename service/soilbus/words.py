"""Words of messages: foreign names as a terminal may have them, the known name that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LONGEST_LINE = 5000
"""Characters of a line that are shown: a path as long as Linux allows (PATH_MAX, 4096), and what is said of it."""

LONGEST_NAME = 300
"""Characters of a name that are shown: more than a file's name may have on usual file systems (NAME_MAX, 255)."""


class WorkError(Exception):
    """Error of work that could not be done; the text is one line for the user."""


def shown(text: object, most: int = LONGEST_LINE) -> str:
    """Return a text as one line: unprintable characters by their codes, the middle of a long one cut out.

    Names of files, signals and vehicles may hold anything: escape sequences, line breaks, marks that turn the direction
    of writing.  Applied again it changes nothing.

    Examples
    --------
    >>> print(shown("red" + chr(27) + "[31m" + chr(10)))
    red\\x1b[31m\\n
    >>> shown("0123456789", 5)
    '01…89'
    """
    line = str(text)
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    half = most // 2
    return line if len(line) <= most else f"{line[: most - half - 1]}…{line[-half:]}"


def text_of(lines: Iterable[object]) -> str:
    """Return lines as `shown`, each with its end."""
    return "".join(f"{shown(line)}\n" for line in lines)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean radius?" with the nearest known name, or nothing where none is near."""
    folded = {n.casefold(): n for n in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[close[0]]}?" if close else ""


def one_line(error: Exception, most: int | None = None) -> str:
    """Return what an error says in one line of at most `most` characters; its type where it says nothing."""
    return " ".join(str(error).split())[:most] or type(error).__name__
