"""Advice: why windows gave no valid estimate, and what to do about it, in one line with figures of the data.

A status and reason is a sentence; where the load varied too little, the sentence gives the mean and the standard
deviation of draft and slip within a window, beside those of the valid windows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soilbus.decision.traversability import Status
from soilbus.pipeline.result import WindowResult

DIAGNOSE = "record it and run soilbus diagnose"


def advice(windows: Sequence[WindowResult], valid: Sequence[WindowResult]) -> str | None:
    """Return one line on windows of one status and reason beside the valid ones of the run; None without advice."""
    kind, *names = windows[0].reason.split()
    what = ", ".join(names)
    match kind:
        case "not_excited" if names == ["new_soil"]:
            return "the ground had just changed: nothing to do but drive on"
        case "not_excited" if names == ["few_bins"]:
            return "a window holds too few values for a soil: set a shorter estimator.bin or a longer estimator.window"
        case "not_excited":
            return _vary(windows, valid)
        case "standstill":
            return "the vehicle stood or crept, or slipped beyond traversability.max_slip: drive on, with less pull"
        case "turning":
            return "the vehicle turned, so its wheels have no common ground speed: drive straight"
        case "input_missing":
            silent = ", ".join(name for name in names if name != "wheels")
            said = [f"no usable value of {silent} ever came: check the mapping, and that this bus carries it"]
            unmapped = ["no wheel that drives has a torque and a speed mapped, its own or its axle's"]
            return "; ".join(said * bool(silent) + unmapped * ("wheels" in names))
        case "input_stale":
            return f"{what} had pauses: check the sender and the wiring, or set a timeout that fits its rate"
        case "input_rejected":
            what = ", ".join(name for name in names if not name.startswith("("))
            return f"{what}: the counters do not go on by one: look for a second sender, or for lost frames"
        case "implausible":
            return f"{what} contradicts the other sensors: check mounting, sign, scale and wiring"
        case "model_mismatch":
            off = _mispredicted(windows)
            if what:
                off += f"{what} is mapped for several wheels: if it is the cell of one, map it for that one alone; or "
            return f"{off}check mass, radii, gear ratios, signs, slope and [noise]; else {DIAGNOSE}"
        case "no_convergence":
            return f"no soil explains these data ({_moved(windows)}): check signs and scales; else {DIAGNOSE}"
    return None


def _mispredicted(windows: Sequence[WindowResult]) -> str:
    """Return how far off the model predicts its worst channel, in the median of the windows."""
    channels = sorted({name for w in windows for name in w.prediction_error})
    shares = {c: float(np.median([w.prediction_error.get(c, 0.0) for w in windows])) for c in channels}
    if not shares:
        return ""
    worst = max(shares, key=shares.__getitem__)
    return f"the model predicts {worst} {100.0 * shares[worst]:.0f} % off: "


def _vary(windows: Sequence[WindowResult], valid: Sequence[WindowResult]) -> str:
    """What varied too little in these windows, beside the valid ones."""
    here, there = _draft(windows), _draft(valid)
    if here is None or there is None:
        return f"vary the load more: {_moved(windows)}"
    if here[1] < there[1]:
        return f"vary the load: {_moved(windows, ' only')}; in the valid windows {_moved(valid)}"
    return f"vary the load for longer on one ground: {_moved(windows)}, as much as in the valid windows"


def _moved(windows: Sequence[WindowResult], only: str = "") -> str:
    """How much draft and slip vary within a window (standard deviations), as medians of the windows."""
    draft, slip = _draft(windows), _typical([(w.excitation.slip, w.excitation.slip_sd) for w in windows])
    said = []
    if draft is not None:
        mean, sd = draft
        newtons = f"{mean:.0f} ± {sd:.0f} N"
        moved = f"moved by {100.0 * sd / abs(mean):.2g} %{only} ({newtons})" if abs(mean) > sd else f"was {newtons}"
        said.append(f"the draft {moved}")
    if slip is not None:
        said.append("slip was {:.1f} ± {:.1f} %".format(*(100.0 * of for of in slip)))
    return ", ".join(said) or "draft and slip are not known"


def _draft(windows: Sequence[WindowResult]) -> tuple[float, float] | None:
    """Of what is towed; None where nothing ever is, which counts as a draft of 0 all along."""
    drafts = [(w.excitation.draft, w.excitation.draft_sd) for w in windows]
    return None if all(draft == (0.0, 0.0) for draft in drafts) else _typical(drafts)


def _typical(of: Sequence[tuple[float | None, float | None]]) -> tuple[float, float] | None:
    """Medians of known means and standard deviations."""
    known = [(mean, sd) for mean, sd in of if mean is not None and sd is not None]
    if not known:
        return None
    mean, sd = np.median(known, axis=0).tolist()
    return mean, sd


def of_use(windows: Sequence[WindowResult]) -> list[WindowResult]:
    """Return the windows with an estimate of the soil, of any status."""
    return [window for window in windows if window.status is not Status.INVALID and window.posterior is not None]
