"""DBC -> column plan: a whole window of frames decoded at once.

Every value equals that of `cantools.database.can.Message.decode(..., decode_choices=False)`,
bit for bit.  For the fifty frames of a hop the cost is the number of numpy calls, not the number
of bytes.  So signals of one sign and kind of conversion are cut out together: those that fill
aligned 1, 2 or 4 bytes by looking at the payload as numbers of that size (lanes), others that
share the same eight bytes by two shifts for all of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from cantools.database.can import Message, Signal
from cantools.database.conversion import (
    BaseConversion,
    IdentityConversion,
    LinearConversion,
    LinearIntegerConversion,
    NamedSignalConversion,
)
from numpy.typing import NDArray

from soilbus.can.bits import Place, place_of, top_aligned

Kind = Literal["identity", "integer", "linear", "row"]
Payload = NDArray[np.uint8]
Block = tuple[NDArray[Any], NDArray[Any]]
"""Codes and physical values (rows, N) of signals that were cut out together."""

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}
_FLOAT_BITS = {16: np.uint16, 32: np.uint32, 64: np.uint64}
_EXACT_FLOAT = 2**53
_INT64 = np.dtype(np.int64)
_FLOAT64 = np.dtype(np.float64)
_LIMITS = np.iinfo(np.int64)


class SignalColumn(NamedTuple):
    """Values of one signal in N frames.

    `raw` (N,): codes, int64 (uint64 for 64 unsigned bits, float64 for float signals).
    `physical` (N,): scaled value as cantools gives it, int64, uint64, float64, or objects where
    integers outgrow 64 bits.  `present` (N,): False where the multiplexer leaves the signal out
    and both others are meaningless; None when the signal is in every frame.
    """

    raw: NDArray[Any]
    physical: NDArray[Any]
    present: NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class _Group:
    """Signals cut out and scaled together.

    `lane` is the number type that the payload is looked at as, None where bits are shifted out
    of the word at `place`.  `rows` tells which row of the result is whose; `left`, `right`,
    `scale` and `offset` are (rows, 1), the last two plain numbers where all rows share them.
    `right` is int64 for signed signals, else uint64, so that the shift keeps the sign.
    """

    signals: tuple[Signal, ...]
    rows: tuple[tuple[str, int], ...]
    place: Place
    lane: np.dtype[Any] | None
    signed: bool
    kind: Kind
    left: NDArray[np.uint64]
    right: NDArray[Any]
    scale: Any
    offset: Any
    adds_offset: bool


class ColumnDecoder:
    """Decoder of the named signals of one message, and of the multiplexers they hang on.

    Raises KeyError for a signal that the message does not have and ValueError for one that
    cannot be cut out: outside the message, longer than 64 bits, or defined twice.
    """

    def __init__(self, message: Message, signals: Sequence[str]) -> None:
        self.message = message
        self._length = message.length
        self.signals = tuple(dict.fromkeys(signals))
        wanted = _with_multiplexers(message, self.signals)
        self._multiplexed = tuple(s for s in wanted.values() if s.multiplexer_signal is not None)
        self._groups = _groups(message.length, list(wanted.values()))
        self.rows = tuple(group.rows for group in self._groups)

    def columns(self, payload: Payload) -> dict[str, SignalColumn]:
        """Return the raw codes, physical values and presence by signal name; payload (N, message length).

        Signals that the wanted ones hang on are among them.  Raises ValueError when the payload
        has another shape or is not bytes.
        """
        return self.columns_of(self.blocks(payload))

    def blocks(self, payload: Payload) -> list[Block]:
        """Return everything decoded, block by block; `rows` names each block's rows.  Errors as `columns`."""
        if payload.ndim != 2 or payload.shape[1] != self._length or payload.dtype != np.uint8:
            expected = f"uint8 (N, {self._length})"
            raise ValueError(f"{self.message.name}: payload is {payload.dtype} {payload.shape}, not {expected}")
        codes = [_codes(group, payload) for group in self._groups]
        return [(c, _scaled(group, c)) for group, c in zip(self._groups, codes, strict=True)]

    def columns_of(self, blocks: Sequence[Block]) -> dict[str, SignalColumn]:
        """Return the columns that `blocks` holds; see `columns`."""
        columns: dict[str, SignalColumn] = {}
        for rows, (codes, values) in zip(self.rows, blocks, strict=True):
            for name, row in rows:
                columns[name] = SignalColumn(codes[row], values[row], None)
        for signal in self._multiplexed:
            columns[signal.name] = columns[signal.name]._replace(present=_presence(signal, columns))
        return columns

    def raw(self, payload: Payload) -> dict[str, NDArray[Any]]:
        """Return the raw codes (N,) by signal name; see `columns`."""
        columns = self.columns(payload)
        return {name: columns[name].raw for name in self.signals}

    def decode(self, payload: Payload) -> dict[str, NDArray[Any]]:
        """Return the physical values (N,) by signal name; see `columns`, and `present` for multiplexed signals."""
        columns = self.columns(payload)
        return {name: columns[name].physical for name in self.signals}

    def present(self, payload: Payload) -> dict[str, NDArray[np.bool_]]:
        """Return whether each frame carries each signal, (N,) by signal name."""
        everywhere = np.ones(len(payload), dtype=np.bool_)
        columns = self.columns(payload)
        masks = {name: columns[name].present for name in self.signals}
        return {name: everywhere if mask is None else mask for name, mask in masks.items()}


def code_limits(signal: Signal) -> tuple[int, int]:
    """Return the least and greatest raw code that the bits of an integer signal can hold."""
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1


def check_decodable(message: Message, name: str) -> Signal:
    """Return the signal of that name; KeyError or ValueError as `ColumnDecoder` says."""
    found = [s for s in message.signals if s.name == name]
    if not found:
        raise KeyError(name)
    if len(found) > 1:
        raise ValueError(f"{message.name}.{name} is defined {len(found)} times")
    signal = found[0]
    if signal.length > 64:
        raise ValueError(f"{message.name}.{name} is longer than 64 bits")
    if signal.conversion.is_float and signal.length not in _FLOATS:
        raise ValueError(f"{message.name}.{name} is a float of {signal.length} bits")
    place_of(signal.start, signal.length, signal.byte_order == "big_endian", message.length)
    return signal


def _with_multiplexers(message: Message, names: Sequence[str]) -> dict[str, Signal]:
    """Signals by name, each after the multiplexer that it hangs on."""
    ordered: dict[str, Signal] = {}

    def add(name: str) -> None:
        signal = check_decodable(message, name)
        if signal.multiplexer_signal is not None and signal.multiplexer_signal not in ordered:
            add(signal.multiplexer_signal)
        ordered[name] = signal

    for name in names:
        if name not in ordered:
            add(name)
    return ordered


def _presence(signal: Signal, columns: dict[str, SignalColumn]) -> NDArray[np.bool_]:
    """Where the multiplexer of a signal selects it; the multiplexer's own presence is known already."""
    above = columns[str(signal.multiplexer_signal)]
    mask: NDArray[np.bool_] = np.isin(above.physical, list(signal.multiplexer_ids or ()))
    return mask if above.present is None else mask & above.present


def _groups(length: int, signals: list[Signal]) -> list[_Group]:
    """The signals in groups; of several in the same lane (multiplexed ones) each in another group, with its scale."""
    sorted_in: dict[tuple[Any, ...], list[Signal]] = {}
    in_lane: Counter[tuple[Any, ...]] = Counter()
    for signal in signals:
        place, _ = _place(signal, length)
        is_float = bool(signal.conversion.is_float)
        kind: Kind = "row" if is_float else _kind(signal)
        if kind == "row" or signal.length == 64:
            key: tuple[Any, ...] = (signal.name,)
        elif _lane(signal, length) is not None:
            lanes = signal.length, signal.byte_order, signal.is_signed, kind
            key = (*lanes, in_lane[*lanes, signal.start])
            in_lane[*lanes, signal.start] += 1
        else:
            key = (place, signal.is_signed, kind)
        sorted_in.setdefault(key, []).append(signal)
    return [_group(length, members) for members in sorted_in.values()]


def _group(length: int, members: list[Signal]) -> _Group:
    first = members[0]
    is_float = bool(first.conversion.is_float)
    kind: Kind = "row" if is_float else _kind(first)
    number = np.float64 if kind == "linear" else np.int64 if kind == "integer" else np.object_
    lane = None if kind == "row" or first.length == 64 else _lane(first, length)
    size = first.length // 8
    count = len(members) if lane is None else length // size
    rows = [(s.name, i if lane is None else s.start // 8 // size) for i, s in enumerate(members)]
    conversions = [_plain(signal) for signal in members]
    # lanes that nobody asked for are scaled like the first
    scale = np.full((count, 1), conversions[0].scale, dtype=number)
    offset = np.full((count, 1), conversions[0].offset, dtype=number)
    for (_, row), conversion in zip(rows, conversions, strict=True):
        scale[row], offset[row] = conversion.scale, conversion.offset
    signed = first.is_signed and not is_float
    return _Group(
        signals=tuple(members),
        rows=tuple(rows),
        place=_place(first, length)[0],
        lane=lane,
        signed=signed,
        kind=kind,
        left=_stacked([_place(s, length)[1] for s in members], np.uint64),
        right=_stacked([64 - s.length for s in members], np.int64 if signed else np.uint64),
        scale=shared(scale),
        offset=shared(offset),
        # adding zero matters only for minus zero, which a positive scale cannot give
        adds_offset=any(c.offset != 0 or c.scale <= 0 for c in conversions),
    )


def _place(signal: Signal, length: int) -> tuple[Place, int]:
    return place_of(signal.start, signal.length, signal.byte_order == "big_endian", length)


def _lane(signal: Signal, length: int) -> np.dtype[Any] | None:
    """Number type of a signal that fills aligned bytes of a message, None for others."""
    size, big_endian = signal.length // 8, signal.byte_order == "big_endian"
    aligned = signal.length in (8, 16, 32) and signal.start % 8 == (7 if big_endian else 0)
    if not aligned or signal.start // 8 % size or length % size:
        return None
    return np.dtype(f"{'>' if big_endian else '<'}{'i' if signal.is_signed else 'u'}{size}")


def shared(column: NDArray[Any]) -> Any:
    """Return the number that all rows share, else the column itself."""
    return column[0, 0] if (column == column[0, 0]).all() else column


def _stacked(values: Sequence[Any], dtype: Any) -> NDArray[Any]:
    return np.array(values, dtype=dtype).reshape(-1, 1)


def _plain(signal: Signal) -> BaseConversion:
    """The conversion that remains when value names are not asked for."""
    conversion = signal.conversion
    if isinstance(conversion, NamedSignalConversion):
        return BaseConversion.factory(conversion.scale, conversion.offset, None, conversion.is_float)
    return conversion


def _kind(signal: Signal) -> Kind:
    """How an integer signal is scaled; "row" where 64 bits cannot follow Python's integers."""
    conversion = _plain(signal)
    if isinstance(conversion, IdentityConversion):
        return "identity"
    low, high = code_limits(signal)
    products = [low * conversion.scale, high * conversion.scale]
    if isinstance(conversion, LinearIntegerConversion):
        numbers = [high, *products, *(p + conversion.offset for p in products), conversion.scale, conversion.offset]
        return "integer" if all(_LIMITS.min <= n <= _LIMITS.max for n in numbers) else "row"
    if isinstance(conversion, LinearConversion):
        exact = isinstance(conversion.scale, int) and max(abs(p) for p in products) > _EXACT_FLOAT
        return "row" if exact else "linear"
    return "row"


def _codes(group: _Group, payload: Payload) -> NDArray[Any]:
    """Raw codes (rows, N) of a group."""
    if group.lane is not None:
        lanes: NDArray[np.int64] = np.ascontiguousarray(payload).view(group.lane).T.astype(_INT64, order="C")
        return lanes
    top = top_aligned(payload, group.place) << group.left
    if group.signed:
        signed: NDArray[np.int64] = top.view(_INT64) >> group.right
        return signed
    codes: NDArray[np.uint64] = top >> group.right
    first = group.signals[0]
    if first.conversion.is_float:
        bits = codes.astype(_FLOAT_BITS[first.length])
        with np.errstate(invalid="ignore"):  # a signalling nan is still only a nan
            return bits.view(_FLOATS[first.length]).astype(np.float64)
    return codes if first.length == 64 else codes.view(_INT64)


def _scaled(group: _Group, codes: NDArray[Any]) -> NDArray[Any]:
    """Physical values (rows, N) of a group."""
    if group.kind == "identity":
        return codes
    if group.kind == "row":
        return _scaled_by_row(group.signals[0], codes)
    values: NDArray[Any] = codes.astype(_FLOAT64) if group.kind == "linear" else codes.copy()
    values *= group.scale
    if group.adds_offset:
        values += group.offset
    return values


def _scaled_by_row(signal: Signal, codes: NDArray[Any]) -> NDArray[Any]:
    """Python's own arithmetic, value by value: for floats' and integers' rare conversions."""
    conversion = _plain(signal)
    if isinstance(conversion, IdentityConversion):
        return codes
    if signal.conversion.is_float and isinstance(conversion, LinearConversion):
        with np.errstate(over="ignore", invalid="ignore"):
            scaled: NDArray[np.float64] = codes * float(conversion.scale) + float(conversion.offset)
        return scaled
    values = [conversion.raw_to_scaled(code, False) for code in codes[0].tolist()]
    dtype = np.float64 if isinstance(conversion, LinearConversion) else np.object_
    out: NDArray[Any] = np.array([values], dtype=dtype)
    return out
