"""All methods on the same windows: run, score, tabulate."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.posterior import NORMAL_95
from soilbus.report.table import table
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from tests.lab.peers.roster import OURS, Entry
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case, simulated_case

QUANTITIES = ("bearing", "phi", "n", "c", "K")
HIGHEST = {"phi": np.pi / 2.0}


def truth(soil: Soil, quantity: str) -> float:
    """The soil's own value of one of QUANTITIES."""
    return soil.bearing_pressure(Z_REF, B_REF) if quantity == "bearing" else float(getattr(soil, quantity))


@dataclass(frozen=True)
class Score:
    """One method's answers on windows, the true soil of each, and the seconds each took."""

    soils: Sequence[Soil]
    answers: Sequence[Answer | None]
    seconds: Sequence[float]

    @property
    def quantities(self) -> list[str]:
        """What the method estimates, in the table's order."""
        found = {name for answer in self.answers if answer is not None for name in answer}
        return [name for name in QUANTITIES if name in found]

    def errors(self, quantity: str) -> Array:
        """Relative errors (windows,), nan where there is no physical value."""
        value = np.array([a[quantity].value if a is not None and quantity in a else np.nan for a in self.answers])
        true = np.array([truth(soil, quantity) for soil in self.soils])
        physical = (value > 0.0) & (value < HIGHEST.get(quantity, np.inf))
        return np.where(physical, value / true - 1.0, np.nan)

    @property
    def failure_rate(self) -> float:
        """Share of windows without an answer, or with an unphysical value in it (c or K below zero, say)."""
        if not self.quantities:
            return 1.0
        return float(np.mean(np.isnan([self.errors(q) for q in self.quantities]).any(axis=0)))

    def rms(self, quantity: str) -> float:
        """Root mean square of the relative errors; a failure counts as being off by everything."""
        return float(np.sqrt(np.mean(np.nan_to_num(self.errors(quantity), nan=1.0) ** 2)))

    def coverage(self, quantity: str) -> float:
        """Share of windows whose 95 % interval, log-normal, holds the truth; nan without error bars."""
        found = [
            (truth(soil, quantity), answer[quantity])
            for soil, answer in zip(self.soils, self.answers, strict=True)
            if answer is not None and quantity in answer
        ]
        true, value, std = np.array([(true, e.value, e.std) for true, e in found]).T
        if np.isnan(std).all():
            return np.nan
        return float(np.mean(np.abs(np.log(value / true)) <= NORMAL_95 * std / value + 1e-12))


Scores = dict[Entry, Score]


def compared(entries: Sequence[Entry], soils: Sequence[str], windows: int, seed: int) -> Scores:
    """Every entry on so many windows of each soil."""
    runs: dict[Entry, list[tuple[Answer | None, float]]] = {entry: [] for entry in entries}
    for number, name in enumerate(soils):
        for i in range(windows):
            case = simulated_case(SOILS[name], 10_000 * seed + 1000 * number + i)
            for entry in entries:
                runs[entry].append(timed(entry, case))
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
    rows = [
        (
            entry.name,
            entry.given,
            f"{100.0 * score.failure_rate:.0f} %",
            f"{1e3 * float(np.median(score.seconds)):.2g}",
            *(cell(score, quantity) for quantity in QUANTITIES),
        )
        for entry, score in scores.items()
    ]
    return table(("method", "given", "failed", "ms", *QUANTITIES), rows)


def cell(score: Score, quantity: str) -> str:
    """RMS error [coverage], in per cent; empty where it is not estimated."""
    if quantity not in score.quantities:
        return ""
    covered = score.coverage(quantity)
    return f"{100.0 * score.rms(quantity):.2g}" + ("" if np.isnan(covered) else f" [{100.0 * covered:.0f}]")


def duels(scores: Scores) -> Iterator[tuple[Entry, str, bool]]:
    """Peer, quantity, and whether ours that is given the same exactly has the smaller RMS error of it."""
    mine = {entry.exact: score for entry, score in scores.items() if entry.name == OURS}
    for entry, score in scores.items():
        if entry.name != OURS:
            yield from ((entry, q, mine[entry.exact].rms(q) < score.rms(q)) for q in score.quantities)


def ours_is_ahead(scores: Scores) -> bool:
    """Whether ours has a value for every window, and is closer in more than half of the duels."""
    failed = any(score.failure_rate > 0.0 for entry, score in scores.items() if entry.name == OURS)
    closer = [ours for _, _, ours in duels(scores)]
    return not failed and 2 * sum(closer) > len(closer)
