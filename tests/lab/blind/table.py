"""Score of the blind trials: shares with their targets, confusion matrix, calibration of probabilities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from tests.lab.blind.calibration import curve, stated
from tests.lab.blind.trial import Trial

HALVES = ("tune", "mixed", "report")
VISIBLE, BARELY = 100.0, 20.0
CLEAR_GAP = 1.1
FAR = "of which the catalogue leaves over 10 %"


class Figure(NamedTuple):
    """One line of the report; met: whether its target is, None without a target or without a case to judge."""

    text: str
    met: bool | None = None


def report(trials: Sequence[Trial]) -> str:
    """All of it as text."""
    parts = []
    for half in HALVES:
        chosen = [t for t in trials if t.half == half]
        if chosen:
            parts.append(f"== {half}: {len(chosen)} cases")
            parts += [f"  {figure.text}" + "  MISSED" * (figure.met is False) for figure in figures(chosen)]
    parts += ["", "== confusion, visible single effects (rows: hidden; columns: named first)", confusion(trials)]
    parts += ["", "== calibration: stated probability of a name, names, share that was right, its 95 % interval"]
    parts += [
        f"  {b.stated:.2f}  {b.names:4}  {b.right / b.names:.2f}  {b.low:.2f} to {b.high:.2f}"
        for b in curve(stated(trials))
    ]
    return "\n".join(parts) + "\n"


def targets_are_met(trials: Sequence[Trial]) -> bool:
    """Whether the half that nothing is tuned on meets every target; without a case of it, the others.

    Not met, too, where there is no case that any target could be judged by.
    """
    chosen = [t for t in trials if t.half == HALVES[-1]] or trials
    met = [figure.met for figure in figures(chosen) if figure.met is not None]
    return bool(met) and all(met)


def figures(trials: Sequence[Trial]) -> Iterator[Figure]:
    """One for each line.

    What is visible the generator alone says.  Every case that is counts, with any diagnosis: one that
    was not named, or failed, is a miss of each figure.
    """
    single = [t for t in trials if t.kind == "single"]
    visible = [t for t in single if t.visible >= VISIBLE and not t.far]
    barely = [t for t in single if BARELY <= t.visible < VISIBLE and not t.far]
    yield _share("visible: named first", [first(t) == t.hidden[0] for t in visible], least=0.90)
    yield _share("visible: in the set", [t.hidden[0] in in_set(t) for t in visible], least=0.97)
    yield _share("barely visible: in the set", [t.hidden[0] in in_set(t) for t in barely], least=0.80)
    far = [t for t in single if t.visible >= VISIBLE and t.far]
    yield _share(f"visible, by formulas {FAR}: named first", [first(t) == t.hidden[0] for t in far])
    yield _share(f"visible, by formulas {FAR}: in the set", [t.hidden[0] in in_set(t) for t in far])
    yield _share(f"visible, by formulas {FAR}: that or unknown", [_honest(t) for t in far])
    for kind, most in (("plain", 0.03), ("hard", 0.10), ("shaking", 0.10)):
        nulls = [t for t in trials if t.kind == kind]
        yield _share(f"nulls, {kind}: falsely named", [bool(t.named) for t in nulls], most=most)
        yield _share(f"nulls, {kind}: falsely named or unknown", [t.verdict != "none" for t in nulls])
    outside = [t for t in trials if t.kind == "outside" and not t.imitable and t.true_gap > CLEAR_GAP]
    reported = [t.verdict == "unknown" for t in outside]
    yield _share(f"outside the catalogue, not imitable, true gap > {CLEAR_GAP}: unknown", reported, least=0.90)
    pairs = [t for t in trials if t.kind == "pair" and t.visible >= VISIBLE]
    yield _share("pairs: both named", [set(t.hidden) <= set(t.named) for t in pairs])
    yield _share("pairs: both in the sets", [set(t.hidden) <= in_set(t) for t in pairs], least=0.80)
    yield _share("visible: named, and nothing else besides", [set(t.named) == set(t.hidden) for t in visible])
    done = [bool(t.named) and t.gap_after <= 1.15 for t in visible]
    yield _share("visible: named, and the gap after <= 1.15", done, least=0.85)
    excess = [t for t in visible if t.true_gap > CLEAR_GAP]
    gone = [bool(t.named) and t.gap_after - 1.0 <= 0.1 * (t.true_gap - 1.0) for t in excess]
    yield _share(f"visible: 90 % of the excess gone (true gap > {CLEAR_GAP})", gone, least=0.85)
    if visible:
        before, after = (
            float(np.median(np.abs([getattr(t, f"bearing_{w}") for t in visible]))) for w in ("before", "after")
        )
        text = f"bearing pressure, median error: {100 * before:.1f} % -> {100 * after:.1f} %  (<= 2 %)"
        yield Figure(text, after <= 0.02)
        errors = np.array([(t.bearing_after, t.bearing_sd) for t in visible if t.verdict != "failed"]).reshape(-1, 2)
        expected, z = np.median(errors[:, 1]) * norm.ppf(0.75), np.median(np.abs(errors[:, 0] / errors[:, 1]))
        yield Figure(f"  of normal errors of the reported sd: {100 * expected:.1f} %; error over sd: {z:.2f}  (0.67)")
    if trials:
        seconds = [t.seconds for t in trials]
        median, nearly_all = np.quantile(seconds, (0.5, 0.95))
        yield Figure(f"processor time: median {median:.1f} s, 95 % {nearly_all:.1f} s, most {max(seconds):.1f} s")


def _honest(trial: Trial) -> bool:
    """Whether the true name is in the set, or the diagnosis says that nothing it knows explains the data."""
    return trial.hidden[0] in in_set(trial) or trial.verdict == "unknown"


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


def _share(what: str, right: Sequence[bool], least: float | None = None, most: float | None = None) -> Figure:
    n = len(right)
    target = (
        "" if least is most is None else f"  (>= {100 * least:.0f} %)" if least else f"  (<= {100 * (most or 0):.0f} %)"
    )
    if not n:
        return Figure(f"{what}: no case{target}")
    share = sum(right) / n
    met = None if least is most is None else share >= (least or 0.0) and share <= (1.0 if most is None else most)
    return Figure(f"{what}: {sum(right)} of {n} = {100.0 * share:.0f} %{target}", met)
