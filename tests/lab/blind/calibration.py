"""`python -m tests.lab.blind.calibration`: how often a name is right, by the probability stated for it.

    stated   mean probability of the names in a bin
    right    share of them that are hidden in their case, with the 95 % interval of a binomial share (Clopper-Pearson)

Names are those of all sets of blind cases, pairs and recordings of what the catalogue lacks included; those beside a
verdict `unknown` are left out, as the diagnosis itself says that they do not explain the data.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from soilbus.report.table import table
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.reference import REFERENCES, TRACTOR
from tests.lab.blind.cases import KINDS, cases
from tests.lab.blind.trial import NOTHING, tried

BINS = (0.0, 0.1, 0.3, 0.6, 0.8, 0.95, 1.0)
"""Edges of the bins; the last two begin where a name stands alone, and where it is sure at the usual level."""


class Bin(NamedTuple):
    """Names of like probability: how many, their mean probability, how many are right, interval of that share."""

    names: int
    stated: float
    right: int
    low: float
    high: float


def stated(trials: Iterable[Mapping[str, Any]]) -> Iterator[tuple[float, bool]]:
    """Each name's probability, and whether it is hidden in its case; of trials as `Trial.as_json` writes them."""
    for trial in trials:
        if trial["verdict"] != "unknown":
            for names in trial["sets"]:
                yield from ((probability, name in trial["hidden"]) for name, probability in names.items())


def curve(names: Iterable[tuple[float, bool]]) -> list[Bin]:
    """The calibration curve of names with their probabilities; bins without a name are left out."""
    known, found = list(names), []
    for low, high in itertools.pairwise(BINS):
        members = [(p, right) for p, right in known if low < p <= high]
        if members:
            right = sum(right for _, right in members)
            interval = binomtest(right, len(members)).proportion_ci(0.95, "exact")
            mean = float(np.mean([p for p, _ in members]))
            found.append(Bin(len(members), mean, right, float(interval.low), float(interval.high)))
    return found


def draw(figure: Any, bins: Sequence[Bin]) -> None:
    """The curve beside the diagonal, in a matplotlib figure."""
    axes = figure.add_subplot(xlabel="stated probability of a name", ylabel="share of these names that are right")
    share = np.array([b.right / b.names for b in bins])
    error = np.array([(s - b.low, b.high - s) for s, b in zip(share, bins, strict=True)]).T
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
    axes.errorbar([b.stated for b in bins], share, np.maximum(error, 0.0), fmt="o", capsize=3)
    for b, s in zip(bins, share.tolist(), strict=True):
        axes.annotate(f"{b.names}", (b.stated, s), (6, -10), textcoords="offset points", fontsize=8)
    axes.set(xlim=(-0.02, 1.05), ylim=(-0.02, 1.05), aspect="equal")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose, or read what was diagnosed; print the table and draw the curve."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.blind.calibration", description=__doc__)
    parser.add_argument("--seed", type=int, action="append", default=[], help="repeatable")
    parser.add_argument("--every", type=int, metavar="N", default=1, help="take each N-th case only (1)")
    parser.add_argument("--machine", choices=REFERENCES, default=TRACTOR.stem, help=f"what drives ({TRACTOR.stem})")
    parser.add_argument(
        "--trials", type=Path, action="append", default=[], help="read what `blind --json` wrote; repeatable"
    )
    parser.add_argument("--svg", help="draw the curve")
    chosen = parser.parse_args(arguments)
    read = [json.loads(line) for path in chosen.trials for line in path.read_text().splitlines()]
    made = (one for seed in chosen.seed for one in _diagnosed(seed, chosen.every, chosen.machine))
    bins = curve(stated(itertools.chain(read, made)))
    rows = [(f"{b.stated:.2f}", f"{b.names}", f"{b.right / b.names:.2f}", f"{b.low:.2f} to {b.high:.2f}") for b in bins]
    print(table(("stated", "names", "right", "95 % interval"), rows))
    if chosen.svg:
        _save(bins, chosen.svg)
    return 0


def _diagnosed(seed: int, every: int, machine: str) -> Iterator[dict[str, Any]]:
    """Each N-th case of a seed; what cannot be driven is left out."""
    for case in [case for kind in KINDS for case in cases(kind, seed, machine)][:: max(every, 1)]:
        try:
            yield tried(case, truth=NOTHING).as_json()
        except SimulationError:
            continue


def _save(bins: Sequence[Bin], path: str) -> None:
    """The picture, the same bytes for the same bins."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "calibration", "font.size": 9}):
        figure = Figure(figsize=(4.2, 4.0), layout="constrained")
        draw(figure, bins)
        figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    raise SystemExit(main())
