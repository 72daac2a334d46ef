"""Messages whose checksums or counters cannot be trusted, in words of a vehicle engineer."""

from __future__ import annotations

from collections import Counter, deque

from soilbus.can.admission import Counts
from soilbus.can.channels import Reason

WRONG_CHECKSUMS = 0.05  # share of a message's frames from which wrong checksums are said; a good bus has none
SPAN = 10.0  # time [s] over which a service counts them: a default window

MEANING = {
    Reason.BAD_CHECKSUM: "wrong Checksum: a second sender or a bad connection; where nearly all are wrong, another"
    " maker's checksum (dbc.checked, dbc/README.md)",
    Reason.SECOND_SENDER: "the Counter does not go on by one: a second sender, or most frames are lost",
}


def doubts(received: Counter[str], refused: Counter[tuple[str, Reason]]) -> dict[str, str]:
    """Return a line for each message with a second sender or with many wrong checksums, by message and reason."""
    lines = {}
    for (name, reason), n in sorted(refused.items()):
        share = n / max(received[name], n)
        if n and (reason is Reason.SECOND_SENDER or (reason is Reason.BAD_CHECKSUM and share >= WRONG_CHECKSUMS)):
            said = f"{share:.0%} of {received[name]} frames of {name} are refused"
            lines[f"{name} {reason}"] = f"{said}: {MEANING[reason]}"
    return lines


class RecentDoubts:
    """The doubts of the last SPAN seconds of counts that go on."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._before: deque[tuple[float, Counter[str], Counter[tuple[str, Reason]]]] = deque()

    def at(self, now: float) -> dict[str, str]:
        """Return the lines of `doubts` at `now` [s], which does not go back; call it about once a second."""
        received, refused = self._counts.received.copy(), self._counts.refused.copy()
        self._before.append((now, received, refused))
        while self._before[0][0] < now - SPAN:
            self._before.popleft()
        _, received_before, refused_before = self._before[0]
        return doubts(received - received_before, refused - refused_before)
