"""What the trials come to: shares with their targets, confusion matrix, calibration of probabilities."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import chi2, norm

from .trial import Trial

VISIBLE, BARELY = 100.0, 20.0
BINS = (0.0, 0.2, 0.5, 0.8, 0.95, 1.001)
UNTOLD = 0.005
"""Probability that a name outside the set is taken to be given."""


def report(trials: Sequence[Trial]) -> str:
    """All of it as text."""
    parts = []
    for half in ("tune", "report"):
        chosen = [t for t in trials if t.half == half]
        parts.append(f"== {half} half: {len(chosen)} cases")
        parts += [f"  {line}" for line in shares(chosen)]
    parts += ["", "== confusion, visible single effects (rows: hidden; columns: named first)", confusion(trials)]
    parts += ["", "== calibration: probability told of a name, names, share that was right", *calibration(trials)]
    return "\n".join(parts) + "\n"


def shares(trials: Sequence[Trial]) -> Iterator[str]:
    """One line for each figure."""
    single = [t for t in trials if t.kind == "single"]
    visible = [t for t in single if t.visible >= VISIBLE]
    barely = [t for t in single if BARELY <= t.visible < VISIBLE]
    yield _share("visible: named first", [first(t) == t.hidden[0] for t in visible], ">= 90 %")
    yield _share("visible: in the set", [t.hidden[0] in in_set(t) for t in visible], ">= 97 %")
    yield _share("barely visible: in the set", [t.hidden[0] in in_set(t) for t in barely], ">= 80 %")
    for kind, most in (("plain", "<= 3 %"), ("hard", "<= 10 %")):
        nulls = [t for t in trials if t.kind == kind]
        yield _share(f"nulls, {kind}: falsely named", [bool(t.named) for t in nulls], most)
        yield _share(f"nulls, {kind}: falsely named or unknown", [t.verdict != "none" for t in nulls], "")
    outside = [t for t in trials if t.kind == "outside" and not t.imitable and t.gap_before > 1.1]
    yield _share(
        "outside the catalogue, not imitable, gap > 1.1: unknown", [t.verdict == "unknown" for t in outside], ">= 90 %"
    )
    pairs = [t for t in trials if t.kind == "pair" and t.visible >= VISIBLE]
    yield _share("pairs: both named", [set(t.hidden) <= set(t.named) for t in pairs], "")
    yield _share("pairs: both in the sets", [set(t.hidden) <= in_set(t) for t in pairs], ">= 80 %")
    done = [t for t in visible if t.named]
    yield _share("visible and named: nothing else is named besides", [len(t.named) == 1 for t in done], "")
    yield _share("completed: gap <= 1.15", [t.gap_after <= 1.15 for t in done], ">= 85 %")
    excess = [t for t in done if t.gap_before > 1.1]
    gone = [t.gap_after - 1.0 <= 0.1 * (t.gap_before - 1.0) for t in excess]
    yield _share("completed: 90 % of the excess gone (gap before > 1.1)", gone, ">= 85 %")
    if excess:
        held = [_by_noise(0.1 * (t.gap_before - 1.0), t.rows) for t in excess]
        yield f"  the same of models without any error, whose gaps are 1 and noise: {100.0 * np.mean(held):.0f} %"
    if done:
        before, after = (
            float(np.median(np.abs([getattr(t, f"bearing_{w}") for t in done]))) for w in ("before", "after")
        )
        yield f"bearing pressure, median error: {100 * before:.1f} % -> {100 * after:.1f} %  (<= 2 %)"
        errors = np.array([(t.bearing_after, t.bearing_sd) for t in done])
        expected, z = np.median(errors[:, 1]) * norm.ppf(0.75), np.median(np.abs(errors[:, 0] / errors[:, 1]))
        yield f"  of normal errors of the told sd: {100 * expected:.1f} %; error over told sd: {z:.2f}  (0.67)"
    if trials:
        seconds = [t.seconds for t in trials]
        median, nearly_all = np.quantile(seconds, (0.5, 0.95))
        yield f"processor time: median {median:.1f} s, 95 % {nearly_all:.1f} s, most {max(seconds):.1f} s  (<= 5 s)"


def _by_noise(least: float, rows: int) -> float:
    """Probability that a reduced chi-square of so many residuals that are noise is no farther above 1 than this."""
    return float(chi2.cdf((1.0 + least) * rows, rows))


def first(trial: Trial) -> str:
    """The name that explains most, empty where none is given."""
    return trial.named[0] if trial.named else ""


def in_set(trial: Trial) -> set[str]:
    """Every name that is given with a probability."""
    return {name for one in trial.sets for name in one}


def confusion(trials: Sequence[Trial]) -> str:
    """Hidden against first named, visible single effects only; what is right is a plain count."""
    counts: dict[str, Counter[str]] = {}
    for t in trials:
        if t.kind == "single" and t.visible >= VISIBLE:
            counts.setdefault(t.hidden[0], Counter())[first(t) or t.verdict] += 1
    return "\n".join(
        f"  {hidden:18} " + ", ".join(f"{name} {n}" for name, n in named.most_common())
        for hidden, named in counts.items()
    )


def calibration(trials: Sequence[Trial]) -> Iterator[str]:
    """Every name of the first sets of visible and barely visible single effects: told, cases, share that was right.

    Then the expected calibration error, over these bins, and the mean logarithmic score of
    what was told of the truth (Gneiting & Raftery 2007, J. Am. Stat. Assoc. 102:359); a
    name that is not told of shares UNTOLD.
    """
    chosen = [t for t in trials if t.kind == "single" and t.named and t.visible >= BARELY]
    told = [(p, name == t.hidden[0]) for t in chosen for name, p in t.sets[0].items()]
    error = 0.0
    for low, high in itertools.pairwise(BINS):
        members = [(p, right) for p, right in told if low <= p < high]
        if members:
            mean, share = (float(np.mean(column)) for column in zip(*members, strict=True))
            error += abs(mean - share) * len(members) / len(told)
            yield f"  {mean:.2f}  {len(members):4}  {share:.2f}"
    if chosen:
        score = float(np.mean([-np.log(t.sets[0].get(t.hidden[0], UNTOLD)) for t in chosen]))
        yield f"  expected calibration error {error:.3f}, logarithmic score {score:.3f} of {len(chosen)} cases"


def _share(what: str, right: Sequence[bool], target: str) -> str:
    n = len(right)
    return (
        f"{what}: {sum(right)} of {n}"
        + (f" = {100.0 * sum(right) / n:.0f} %" if n else "")
        + f"  ({target})" * bool(target)
    )
