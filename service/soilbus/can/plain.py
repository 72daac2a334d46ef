"""Batches in which every code is a plain value: judged and brought to SI in one go.

Nearly every batch is one.  Judging it channel by channel costs some twenty numpy calls a
channel only to find nothing.  Here each row of the decoder's blocks has one range of codes
that are certainly admitted; a batch within all of them needs no other judgement, and any other
batch goes the detailed way of `can.validity`, which alone says what is refused and why.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from soilbus.can.channels import Channel
from soilbus.can.decode import Block, ColumnDecoder, code_limits, shared
from soilbus.can.validity import CodeRule

MAX_BITS = 53
"""Longer codes are not exact as float64, so their ranges cannot be found by halving."""

_ANY = (0, (1 << 64) - 1)


@dataclass(frozen=True, slots=True)
class _BlockPlan:
    """One block: admitted codes of its rows, and the channels taken from it.

    Row i admits low[i] .. low[i] + span[i], both (rows, 1); `pick` are the channels' rows,
    factor and offset bring them to SI: (channels, 1), or plain numbers where all share them.
    """

    low: NDArray[np.int64]
    span: NDArray[np.uint64]
    names: tuple[str, ...]
    pick: slice | NDArray[np.intp]
    factor: Any
    offset: Any


@dataclass(frozen=True, slots=True)
class PlainPlan:
    """Plan for decoding a message whose channels are all integer codes."""

    blocks: tuple[_BlockPlan, ...]

    def samples(self, blocks: Sequence[Block]) -> dict[str, NDArray[np.float64]] | None:
        """Return the SI values (N,) by channel name; None where any code needs the detailed judgement.

        `blocks` are those of the decoder, for N frames.
        """
        for plan, (codes, _) in zip(self.blocks, blocks, strict=True):
            # what is below wraps round to the largest numbers: one comparison for both ends
            if np.count_nonzero((codes - plan.low).view(np.uint64) > plan.span):
                return None
        samples: dict[str, NDArray[np.float64]] = {}
        for plan, (_, physical) in zip(self.blocks, blocks, strict=True):
            if plan.names:
                values = plan.factor * physical[plan.pick].astype(np.float64, copy=False) + plan.offset
                samples.update(zip(plan.names, values, strict=True))
        return samples


def plain_plan(
    message: Message, channels: Sequence[Channel], rules: Sequence[CodeRule], decoder: ColumnDecoder
) -> PlainPlan | None:
    """Return the plan of a message's channels; None with floats, multiplexers or very long codes."""
    signals = {s.name: s for s in message.signals}
    if not all(_is_simple(signals[name]) for rows in decoder.rows for name, _ in rows):
        return None
    admitted: dict[str, tuple[int, int]] = {}
    for channel, rule in zip(channels, rules, strict=True):
        _narrow(admitted, channel.signal, _admitted_codes(signals[channel.signal], channel, rule))
        if channel.valid_signal is not None:
            _narrow(admitted, channel.valid_signal, _longest_run(channel.valid_values))
    if any(low > high for low, high in admitted.values()):
        return None
    heights = [len(codes) for codes, _ in decoder.blocks(np.zeros((0, message.length), np.uint8))]
    return PlainPlan(
        tuple(_block_plan(dict(r), height, channels, admitted) for r, height in zip(decoder.rows, heights, strict=True))
    )


def _is_simple(signal: Signal) -> bool:
    return signal.length <= MAX_BITS and not signal.conversion.is_float and signal.multiplexer_signal is None


def _narrow(admitted: dict[str, tuple[int, int]], name: str, codes: tuple[int, int]) -> None:
    low, high = admitted.get(name, codes)
    admitted[name] = max(low, codes[0]), min(high, codes[1])


def _block_plan(
    row_of: Mapping[str, int], height: int, channels: Iterable[Channel], admitted: Mapping[str, tuple[int, int]]
) -> _BlockPlan:
    ranges = {row_of[name]: codes for name, codes in admitted.items() if name in row_of}
    bounds = [ranges.get(row, _ANY) for row in range(height)]
    members = [c for c in channels if c.signal in row_of]
    pick = [row_of[c.signal] for c in members]
    return _BlockPlan(
        low=_column([low for low, _ in bounds], np.int64),
        span=_column([high - low for low, high in bounds], np.uint64),
        names=tuple(c.name for c in members),
        pick=_as_slice(pick),
        factor=shared(_column([c.factor for c in members], np.float64)) if members else 1.0,
        offset=shared(_column([c.offset for c in members], np.float64)) if members else 0.0,
    )


def _as_slice(rows: Sequence[int]) -> slice | NDArray[np.intp]:
    """The rows as a slice where they follow one another, which spares a copy."""
    if rows and list(rows) == list(range(rows[0], rows[0] + len(rows))):
        return slice(rows[0], rows[0] + len(rows))
    return np.array(rows, np.intp)


def _column(values: Sequence[Any], dtype: Any) -> NDArray[Any]:
    return np.array(values, dtype=dtype).reshape(-1, 1)


def _admitted_codes(signal: Signal, channel: Channel, rule: CodeRule) -> tuple[int, int]:
    """Longest range of codes that the rule and the channel's limits admit; first > last where there is none.

    The value in SI never turns round between two codes, so codes within the limits are one
    range, whose ends are found by halving.
    """
    first, last = code_limits(signal)
    first, last = max(first, math.ceil(rule.low)), min(last, math.floor(rule.high))
    cuts = sorted({code for code, _ in rule.special if first <= code <= last})
    ends = [first - 1, *cuts, last + 1]
    first, last = max(((a + 1, b - 1) for a, b in pairwise(ends)), key=lambda r: r[1] - r[0])

    def value(code: int) -> float:
        physical: Any = signal.conversion.raw_to_scaled(code, False)
        return channel.factor * float(physical) + channel.offset

    if first > last:
        return first, last
    if value(first) <= value(last):
        low = _first_code(first, last, lambda code: value(code) >= channel.low)
        high = _first_code(first, last, lambda code: not value(code) <= channel.high) - 1
    else:
        low = _first_code(first, last, lambda code: value(code) <= channel.high)
        high = _first_code(first, last, lambda code: not value(code) >= channel.low) - 1
    return low, high


def _first_code(first: int, last: int, reached: Callable[[int], bool]) -> int:
    """First code from which on `reached` holds; last + 1 where there is none."""
    codes = range(first, last + 1)
    return first + bisect_left(codes, True, key=reached)


def _longest_run(values: Iterable[int]) -> tuple[int, int]:
    """Ends of the longest run of consecutive integers; first > last for no integer."""
    known = set(values)
    best = (0, -1)
    for first in sorted(v for v in known if v - 1 not in known):
        last = first
        while last + 1 in known:
            last += 1
        if last - first > best[1] - best[0]:
            best = (first, last)
    return best
