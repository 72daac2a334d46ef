"""All methods on the same windows: run, score, tabulate."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from soilbus.report.table import table
from soilbus.terra.soils import SOILS
from tests.lab.peers.roster import OURS, Entry
from tests.lab.peers.scores import QUANTITIES, Duel, Score, duel
from tests.lab.peers.windows import Answer, Case, simulated_case

Scores = dict[str, dict[Entry, Score]]
"""By soil and entry."""


def compared(
    entries: Sequence[Entry], soils: Sequence[str], windows: int, seed: int, step: Callable[[], None]
) -> Scores:
    """Every entry on every window; `step` is called after each window."""
    scores: Scores = {}
    for number, name in enumerate(soils):
        runs: dict[Entry, list[tuple[Answer | None, float]]] = {entry: [] for entry in entries}
        for i in range(windows):
            case = simulated_case(SOILS[name], 10_000 * seed + 1000 * number + i)
            for entry in entries:
                runs[entry].append(timed(entry, case))
            step()
        scores[name] = {e: Score(SOILS[name], *zip(*of, strict=True)) for e, of in runs.items()}
    return scores


def timed(entry: Entry, case: Case) -> tuple[Answer | None, float]:
    """An entry's answer, and the seconds that it took."""
    case = case.knowing(entry.exact)
    _ = case.prior, case.problem  # configuration, not estimation
    begin = time.perf_counter()
    answer = entry.method(case)
    return answer, time.perf_counter() - begin


def tables(scores: Scores) -> Iterator[str]:
    """One table for each soil."""
    for soil, of_soil in scores.items():
        rows = [
            (
                e.name,
                e.given,
                f"{100.0 * s.failure_rate:.0f} %",
                f"{s.milliseconds:.1f}",
                *(cell(s, q) for q in QUANTITIES),
            )
            for e, s in of_soil.items()
        ]
        yield f"{soil}\n{table(('method', 'given', 'failed', 'ms', *QUANTITIES), rows)}"


def cell(score: Score, quantity: str) -> str:
    """RMS error / median error [coverage], all in per cent; empty where it is not estimated."""
    if quantity not in score.quantities:
        return ""
    if np.isnan(score.errors(quantity)).all():
        return "all failed"
    covered = score.coverage(quantity)
    bars = "" if np.isnan(covered) else f" [{100.0 * covered:.0f}]"
    return f"{100.0 * score.rms(quantity):.2g} / {100.0 * score.median(quantity):.2g}{bars}"


def duels(scores: Scores) -> Iterator[tuple[Entry, str, str, Duel]]:
    """Peer, quantity, soil, and how it does against ours that is given the same exactly."""
    for soil, of_soil in scores.items():
        mine = {e.exact: s for e, s in of_soil.items() if e.name == OURS}
        for entry, score in of_soil.items():
            if entry.name == OURS:
                continue
            for quantity in score.quantities:
                result = duel(score, mine[entry.exact], quantity) if entry.exact in mine else None
                if result is not None:
                    yield entry, quantity, soil, result


def verdict(scores: Scores) -> str:
    """Where peers win, by error and by time; computed from the scores alone."""
    wins: dict[tuple[str, str, str], list[str]] = {}
    tally: Counter[tuple[str, bool]] = Counter()
    for entry, quantity, soil, d in duels(scores):
        tally[d.better, d.by_chance] += 1
        if d.better == "peer":
            doubt = " (?)" if d.by_chance else ""
            failed = scores[soil][entry].failure_rate
            given = entry.given + (f", fails in {100.0 * failed:.0f} %" if failed else "")
            won = f"{quantity} {100.0 * d.peer:.2g} < {100.0 * d.ours:.2g}{doubt}"
            wins.setdefault((entry.name, given, soil), []).append(won)
    rows = [(*of, ", ".join(won)) for of, won in wins.items()]
    head = ("peer", "given", "soil", "RMS error, peer's < ours [%]; (?): may be chance, by a sign test")
    text = "Where a peer beats ours that is given the same exactly (windows where both have a value)\n"
    text += table(head, rows) if rows else "nowhere\n"
    both = {who: (tally[who, False], tally[who, True]) for who in ("ours", "peer")}
    alike = tally["neither", False] + tally["neither", True]
    return (
        f"{text}\nOf {sum(tally.values())} comparisons by soil and quantity: ours is better in {both['ours'][0]} "
        f"(and perhaps {both['ours'][1]} more), a peer in {both['peer'][0]} (and perhaps {both['peer'][1]} more), "
        f"alike in {alike}.\n\n{_times(scores)}"
    )


def ours_is_ahead(scores: Scores) -> bool:
    """Whether ours has a value for every window, and is the better one as often as peers that are given the same."""
    better = Counter(d.better for _, _, _, d in duels(scores))
    failed = any(score.failure_rate > 0.0 for found in scores.values() for e, score in found.items() if e.name == OURS)
    return not failed and better["ours"] >= better["peer"]


def _times(scores: Scores) -> str:
    """Median time of each method over ours."""
    seconds: dict[str, list[float]] = {}
    for of_soil in scores.values():
        for entry, score in of_soil.items():
            if not entry.exact:  # every method has such a row
                seconds.setdefault(entry.name, []).extend(score.seconds)
    median = {name: 1e3 * float(np.median(s)) for name, s in seconds.items()}
    quick = [f"{name} {ms:.2g} ms" for name, ms in median.items() if ms < median[OURS]]
    slow = [f"{name} {ms:.2g} ms ({ms / median[OURS]:.0f} times)" for name, ms in median.items() if ms > median[OURS]]
    return (
        f"Time for a window, median: ours {median[OURS]:.2g} ms. "
        f"Faster: {', '.join(quick) or 'none'}. Slower: {', '.join(slow) or 'none'}.\n"
    )
