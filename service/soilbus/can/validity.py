"""Which decoded samples count, and why the others do not; never a zero for a missing value.

Sources: SAE J1939-71 and ISO 11783-7 (top codes of a range: valid to 0xFA.., error 0xFE.., not available 0xFF..); the
field's habit of keeping the most negative code of a signed signal for "not available".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from soilbus.can.channels import Channel, Reason
from soilbus.can.decode import SignalColumn, code_limits

REASONS = tuple(Reason)  # a sample's verdict v: 0 admitted, else refused for REASONS[v - 1]

Verdicts = NDArray[np.uint8]

_VERDICT = {reason: np.uint8(i + 1) for i, reason in enumerate(REASONS)}
_BANDS = {2: (2, 2, 3), 4: (14, 14, 15), 8: (0xFB, 0xFE, 0xFF)}
_BANDS |= {bits: (0xFB << bits - 8, 0xFE << bits - 8, 0xFF << bits - 8) for bits in (16, 24, 32)}

_NO_FAULT = re.compile(r"\b(no|not|without|non) (an )?(errors?|faults?|failures?)\b|\b(error|fault) free\b")
_NOT_AVAILABLE = re.compile(r"\b(sna|n a|na|unavailable|not ?(avail\w*|installed|present)|no (data|signal))\b")
_ERROR = re.compile(r"\b(err|errors?|invalid|not valid|faults?|faulty|fail(ed|ure)?|defect(ive)?|malfunction)\b")
_RESERVED = re.compile(r"\b(reserved|rsvd)\b")
_VOUCHING = re.compile(r"\b(valid|ok|okay|good|normal|healthy|available|yes|true)\b")
_OF_WHAT = re.compile(r"\b(signal|data|values?|status|state|quality|measurement|sensor|operation|is|detected)\b")
"""Words beside a vouching one that change nothing."""


class CodeRule:
    """Rule which raw codes of a signal carry a value, by its DBC entry.

    `low`..`high` are raw codes, of float signals physical values; `bands` the first reserved, error and not-available
    codes, where the range leaves them out; `special` single codes with a meaning of their own.  In a group of the
    standards the top codes never are values.
    """

    def __init__(self, signal: Signal, is_standard: bool = False) -> None:
        self.is_float = signal.conversion.is_float
        meanings = ((code, meaning(str(name))) for code, name in (signal.choices or {}).items())
        self.special = {code: reason for code, reason in meanings if reason is not None}
        self.bands = None if self.is_float or signal.is_signed else _BANDS.get(signal.length)
        self.low, self.high = _range_of(signal)
        if is_standard and self.bands is not None:
            self.high = min(self.high, self.bands[0] - 1)
        if signal.length >= 8 and not self.is_float:
            first, last = code_limits(signal)
            top = {first: Reason.NOT_AVAILABLE, last: Reason.SATURATED}
            self.special = (top if signal.is_signed else {last: Reason.NOT_AVAILABLE}) | self.special


def meaning(name: str) -> Reason | None:
    """Return why a code of that name in a value table is no value; None when it is one."""
    text = _in_words(name)
    if _NOT_AVAILABLE.search(text):
        return Reason.NOT_AVAILABLE
    if _ERROR.search(_NO_FAULT.sub("", text)):
        return Reason.ERROR
    return Reason.RESERVED if _RESERVED.search(text) else None


def vouching_codes(signal: Signal) -> tuple[int, ...]:
    """Return the raw codes that vouch for another signal by their names in the value table; () without any."""
    found = []
    for code, name in (signal.choices or {}).items():
        text = _NO_FAULT.sub("ok", _in_words(str(name)))
        rest, count = _VOUCHING.subn("", _OF_WHAT.sub("", text))
        if meaning(str(name)) is None and count > 0 and not rest.strip():
            found.append(code)
    return tuple(sorted(found))


def _in_words(name: str) -> str:
    """Small words with one blank between them."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return " ".join(re.findall(r"[a-z0-9]+", words.lower()))


def judge_codes(rule: CodeRule, raw: NDArray[Any], physical: NDArray[Any]) -> Verdicts:
    """Return the verdict (N,) on the signal's own codes: special codes before the range."""
    verdict = np.zeros(len(raw), dtype=np.uint8)
    seen = physical if rule.is_float else raw
    outside = (seen < rule.low) | (seen > rule.high)
    if outside.any():
        verdict[outside] = _VERDICT[Reason.OUT_OF_RANGE]
        reasons = (Reason.RESERVED, Reason.ERROR, Reason.NOT_AVAILABLE)
        for first, reason in zip(rule.bands or (), reasons, strict=False):
            verdict[outside & (raw >= first)] = _VERDICT[reason]
    if rule.is_float:
        verdict[~np.isfinite(physical)] = _VERDICT[Reason.NOT_FINITE]
    for code, reason in rule.special.items():
        verdict[raw == code] = _VERDICT[reason]
    return verdict


def judge_validity(channel: Channel, length: int, signed: bool, column: SignalColumn) -> Verdicts:
    """Return the verdict (N,) by the signal, `length` bits long, that vouches for another one."""
    raw = column.raw
    verdict = np.full(len(raw), _VERDICT[Reason.NOT_VALID], dtype=np.uint8)
    bands = None if signed else _BANDS.get(length)
    if bands is not None:
        verdict[raw >= bands[1]] = _VERDICT[Reason.ERROR]
        verdict[raw >= bands[2]] = _VERDICT[Reason.NOT_AVAILABLE]
    for code in channel.valid_values:
        verdict[raw == code] = 0
    if column.present is not None:
        verdict[~column.present] = _VERDICT[Reason.NOT_VALID]
    return verdict


def in_si(channel: Channel, physical: NDArray[Any], verdict: Verdicts) -> NDArray[np.float64]:
    """Return values (N,) in SI; mark admitted ones that are implausible in `verdict`."""
    with np.errstate(over="ignore"):
        value: NDArray[np.float64] = channel.factor * physical.astype(np.float64) + channel.offset
    inside = (value >= channel.low) & (value <= channel.high)  # False for nan
    if not inside.all():
        verdict[(verdict == 0) & ~inside] = _VERDICT[Reason.IMPLAUSIBLE]
    return value


def _range_of(signal: Signal) -> tuple[float, float]:
    """Least and greatest raw code within the DBC's range; limits are often printed rounded, so the outer codes.

    Of float signals the physical values, which may pass a limit by their own rounding.
    """
    low, high = signal.minimum, signal.maximum
    if low == high and low in (None, 0):
        low = high = None
    if signal.conversion.is_float:
        least, greatest = (-math.inf if low is None else float(low)), (math.inf if high is None else float(high))
        eps = 2.0**-52 if signal.length == 64 else 2.0**-23 if signal.length == 32 else 2.0**-10
        return least - eps * abs(least), greatest + eps * abs(greatest)
    first, last = code_limits(signal)
    if signal.scale == 0:
        return first, last
    low, high = (None if end is None else (end - signal.offset) / signal.scale for end in (low, high))
    if signal.scale < 0:
        low, high = high, low
    least = first if low is None else _outer(low, math.floor)
    greatest = last if high is None else _outer(high, math.ceil)
    return max(least, first), min(greatest, last)


def _outer(code: float, rounded: Callable[[float], int]) -> int:
    nearest = round(code)
    return nearest if abs(code - nearest) <= 1e-6 + 1e-12 * abs(code) else rounded(code)
