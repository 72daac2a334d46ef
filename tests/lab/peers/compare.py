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

Scores = dict[Entry, Score]


def compared(
    entries: Sequence[Entry], soils: Sequence[str], windows: int, seed: int, step: Callable[[], None]
) -> Scores:
    """Every entry on so many windows of each soil; `step` is called after each window."""
    runs: dict[Entry, list[tuple[Answer | None, float]]] = {entry: [] for entry in entries}
    for number, name in enumerate(soils):
        for i in range(windows):
            case = simulated_case(SOILS[name], 10_000 * seed + 1000 * number + i)
            for entry in entries:
                runs[entry].append(timed(entry, case))
            step()
    true = [SOILS[name] for name in soils for _ in range(windows)]
    return {entry: Score(true, *zip(*of, strict=True)) for entry, of in runs.items()}


def timed(entry: Entry, case: Case) -> tuple[Answer | None, float]:
    """An entry's answer, and the seconds that it took."""
    case = case.knowing(entry.exact)
    _ = case.prior, case.problem  # configuration, not estimation
    begin = time.perf_counter()
    answer = entry.method(case)
    return answer, time.perf_counter() - begin


def comparison(scores: Scores) -> str:
    """One table of all methods."""
    who = {(entry, quantity): d.closer for entry, quantity, d in duels(scores)}
    rows = [
        (
            entry.name,
            entry.given,
            f"{100.0 * score.failure_rate:.0f} %",
            f"{score.milliseconds:.2g}",
            *(f"{cell(score, q)} {who.get((entry, q), '')}".strip() for q in QUANTITIES),
        )
        for entry, score in scores.items()
    ]
    return table(("method", "given", "failed", "ms", *QUANTITIES), rows)


def cell(score: Score, quantity: str) -> str:
    """RMS error / median error [coverage], all in per cent; empty where it is not estimated."""
    if quantity not in score.quantities:
        return ""
    if np.isnan(score.errors(quantity)).all():
        return "all failed"
    covered = score.coverage(quantity)
    bars = "" if np.isnan(covered) else f" [{100.0 * covered:.0f}]"
    return f"{100.0 * score.rms(quantity):.2g} / {100.0 * score.median(quantity):.2g}{bars}"


def duels(scores: Scores) -> Iterator[tuple[Entry, str, Duel]]:
    """Peer, quantity, and how it does against ours that is given the same exactly."""
    mine = {entry.exact: score for entry, score in scores.items() if entry.name == OURS}
    for entry, score in scores.items():
        if entry.name == OURS:
            continue
        for quantity in score.quantities:
            result = duel(score, mine[entry.exact], quantity) if entry.exact in mine else None
            if result is not None:
                yield entry, quantity, result


def verdict(scores: Scores) -> str:
    """How often ours and peers are closer; computed from the scores alone."""
    closer = Counter(d.closer for _, _, d in duels(scores))
    return (
        f"Of {closer.total()} comparisons ours is closer in {closer['ours']}, a peer in {closer['peer']}; "
        f"{closer['alike']} are alike, {closer['open']} open.\n"
    )


def ours_is_ahead(scores: Scores) -> bool:
    """Whether ours has a value for every window, and is closer more often than peers that are given the same."""
    closer = Counter(d.closer for _, _, d in duels(scores))
    failed = any(score.failure_rate > 0.0 for entry, score in scores.items() if entry.name == OURS)
    return not failed and closer["ours"] > closer["peer"]
