"""`python -m tests.lab.monte_carlo_report`: errors of simulated windows, each figure beside its target.

~ marks a target missed by less than two standard errors, * one missed by more
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from soilbus.config.file import load_config, machine
from soilbus.config.model import Config
from soilbus.report.table import table
from soilbus.trials.draws import processes
from tests.lab.monte_carlo import (
    ROUGHLY_KNOWN,
    SOILS,
    WINDOW_LENGTHS,
    BayesRiskFigures,
    Cell,
    as_json,
    monte_carlo,
    sensor_sets,
)

MAX_RMS_RATIO = 1.15
"""Target of the RMS error over the Cramer-Rao bound."""
COVERAGE = (0.93, 0.97)
"""Target of the share of 95 % intervals that hold the truth."""
MAX_CHI2_OFF = 0.03
"""Target of the distance of the mean reduced chi-square from 1."""
BAYES_RISK_NOTE = """Bayes-risk bound of each quantity, in root mean square errors over the Cramer-Rao bound: the least
error of any estimate, averaged over the soils that prior and window allow; the error here of the estimate that attains
it; ours over that.  Where the first is above {most}, no estimate is within the target on all of these soils.
samples: median number of effective ones.
"""
SHARED = """Windows are simulated with the estimator's own wheel-soil model, noise and priors: the figures show how much
of what such a window holds the estimate gets out, and that its intervals are right if the model is."""
_BAYES_RISK_CELL = "{:.2f}+-{:.2f} {:.2f} {:.2f}+-{:.2f}"


def with_progress(cells: Iterable[Cell], config: Config) -> Iterator[Cell]:
    """The same cells, those of a configuration, with a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield from cells
        return
    from rich.console import Console
    from rich.progress import track

    n_cells = len(sensor_sets(config)) * len(SOILS) * len(WINDOW_LENGTHS)
    yield from track(cells, "montecarlo", n_cells, console=Console(stderr=True), transient=True)


def monte_carlo_report(cells: Sequence[Cell]) -> str:
    """RMS ratio and coverage of each quantity, one line a cell, with marks where targets are missed."""
    names = list(dict.fromkeys(name for cell in cells for name in cell.quantities))
    head = ("soil", "window", "sinkage", *names, "chi2", "failed", "open", "fit")
    text = "\n".join([table(head, [_row(cell, names) for cell in cells]), *_notes(cells), SHARED]) + "\n"
    bayes_risk = [(cell, cell.bayes_risk) for cell in cells if cell.bayes_risk is not None]
    if not bayes_risk:
        return text
    head = ("soil", "window", "sinkage", *names, "windows", "samples")
    rows = [_bayes_risk_row(*pair, names) for pair in bayes_risk]
    return text + "\n" + table(head, rows) + "\n" + BAYES_RISK_NOTE.format(most=MAX_RMS_RATIO)


def _bayes_risk_row(cell: Cell, bayes_risk: BayesRiskFigures, names: Sequence[str]) -> tuple[str, ...]:
    columns = bayes_risk.least, bayes_risk.least_scatter, bayes_risk.best, bayes_risk.share, bayes_risk.scatter
    figures = dict(zip(cell.quantities, zip(*(column.tolist() for column in columns), strict=True), strict=True))
    cells_of_row = [_BAYES_RISK_CELL.format(*figures[name]) if name in figures else "held" for name in names]
    fitted = "measured" if cell.sinkage else "none"
    return (
        cell.soil,
        f"{cell.duration:g} s",
        fitted,
        *cells_of_row,
        str(bayes_risk.windows),
        f"{bayes_risk.effective:.0f}",
    )


def _row(cell: Cell, names: Sequence[str]) -> tuple[str, ...]:
    n = cell.windows - cell.failed - cell.not_converged
    figures = dict(zip(cell.quantities, zip(cell.rms.tolist(), cell.coverage.tolist(), strict=True), strict=True))
    of_quantities = [_figure(*figures[name], n) if name in figures else "held" for name in names]
    chi2 = f"{cell.chi2:.3f}{_mark(abs(cell.chi2 - 1.0) - MAX_CHI2_OFF, 0.0)}"
    fitted = "measured" if cell.sinkage else "none"
    counts = (str(cell.failed), str(cell.not_converged))
    return (cell.soil, f"{cell.duration:g} s", fitted, *of_quantities, chi2, *counts, f"{1e3 * cell.seconds:.0f} ms")


def _figure(rms: float, coverage: float, n: int) -> str:
    """Such as "1.02 95.0" of n windows."""
    low, high = COVERAGE
    too_large = _mark(rms - MAX_RMS_RATIO, _rms_scatter(n))
    astray = _mark(max(low - coverage, coverage - high), _coverage_scatter(n))
    return f"{rms:.2f}{too_large} {100.0 * coverage:.1f}{astray}"


def _mark(excess: float, scatter: float) -> str:
    """How far a target is missed: ~ where chance may have done it, * where it can hardly have."""
    if excess <= 0.0:
        return ""
    return "~" if excess < 2.0 * scatter else "*"


def _rms_scatter(n: int) -> float:
    """Standard deviation of the root mean square of n standard normal errors."""
    return math.sqrt(0.5 / max(n, 1))


def _coverage_scatter(n: int) -> float:
    """Standard deviation of the share of n 95 % intervals that hold the truth."""
    return math.sqrt(0.95 * 0.05 / max(n, 1))


def _notes(cells: Sequence[Cell]) -> Iterator[str]:
    n = min(cell.windows for cell in cells)
    low, high = (100.0 * share for share in COVERAGE)
    yield "Each quantity: RMS error over the Cramér-Rao bound, and share of 95 % intervals that hold the truth [%]."
    yield f"Targets: at most {MAX_RMS_RATIO}; {low:.0f} to {high:.0f} %; chi2 1 +- {MAX_CHI2_OFF}."
    scatter = f"{_rms_scatter(n):.3f} and the other by {100.0 * _coverage_scatter(n):.1f} points"
    yield f"{n} windows scatter the one by {scatter}"
    yield "by chance: ~ marks a target missed by less than twice that, * one missed by more."
    yield "failed: no optimum; open: not converged; both are left out.  fit: median processor time, from cold."


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the report, and keep the figures as JSON if asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.monte_carlo_report", description=__doc__)
    parser.add_argument("--config", default="tractor", help="TOML configuration or a reference machine's name")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a value")
    parser.add_argument("--windows", type=int, default=200, help="of each kind (200)")
    parser.add_argument("--exact", type=int, default=0, help="samples of exact posteriors (0)")
    parser.add_argument("--around", type=float, default=0.0, help="std of soils' log (0)")
    parser.add_argument("--seed", type=int, default=1, help="of drives, noise and priors (1)")
    parser.add_argument("--json", type=Path, help="write the figures as JSON")
    chosen = parser.parse_args(arguments)
    config = load_config(machine(chosen.config), [*ROUGHLY_KNOWN, *chosen.set])
    with processes(os.cpu_count() or 1) as each:
        drawn = monte_carlo(
            config, chosen.windows, chosen.seed, each=each, posterior_samples=chosen.exact, around=chosen.around
        )
        cells = list(with_progress(drawn, config))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps([as_json(cell) for cell in cells]))
    print(monte_carlo_report(cells), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
