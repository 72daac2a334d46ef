"""A progress bar on a terminal, nothing in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from soilbus.words import shown


@contextmanager
def progress(title: str) -> Iterator[Callable[[int, float], None] | None]:
    """Give a function to call with frames read and time [s] since the begin; None in a pipe."""
    with phases(title) as say:
        yield say and (lambda frames, t: say(f"{frames} frames, {t:.0f} s of recording"))


@contextmanager
def phases(title: str) -> Iterator[Callable[[str], None] | None]:
    """Give a function to call with what is being done; None in a pipe."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title)
        yield lambda what: bar.update(task, description=escape(shown(f"{title}: {what}")))
