"""A message's signals decoded as columns, a whole window of frames at once.

    payload (N, length) -> eight bytes as one word (N,) -> raw codes (N,) -> physical values (N,)

Every value equals that of `cantools.database.can.Message.decode(..., decode_choices=False)`, bit for bit.
"""

from __future__ import annotations

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

Payload = NDArray[np.uint8]

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}
_FLOAT_BITS = {16: np.uint16, 32: np.uint32, 64: np.uint64}
_EXACT_FLOAT = 2**53
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


class ColumnDecoder:
    """Decoder of the named signals of one message, and of the multiplexers they hang on.

    Raises KeyError for a signal that the message does not have and ValueError for one that
    cannot be cut out: outside the message, longer than 64 bits, or defined twice.
    """

    def __init__(self, message: Message, signals: Sequence[str]) -> None:
        self.message = message
        self._plans = [_plan(message, signal) for signal in _with_multiplexers(message, signals)]

    def columns(self, payload: Payload) -> dict[str, SignalColumn]:
        """Return the raw codes, physical values and presence by signal name; payload (N, message length).

        Signals that the wanted ones hang on are among them.  Raises ValueError when the payload
        has another shape or is not bytes.
        """
        length = self.message.length
        if payload.ndim != 2 or payload.shape[1] != length or payload.dtype != np.uint8:
            expected = f"uint8 (N, {length})"
            raise ValueError(f"{self.message.name}: payload is {payload.dtype} {payload.shape}, not {expected}")
        words: dict[_Place, NDArray[np.uint64]] = {}
        columns: dict[str, SignalColumn] = {}
        with np.errstate(over="ignore", invalid="ignore"):  # a signalling nan is still only a nan
            for plan in self._plans:
                if plan.place not in words:
                    words[plan.place] = _words(payload, plan.place)
                raw = _codes(plan, words[plan.place])
                present: NDArray[np.bool_] | None = None
                if plan.signal.multiplexer_signal is not None:  # whose own presence is known already
                    above = columns[plan.signal.multiplexer_signal]
                    present = np.isin(above.physical, list(plan.signal.multiplexer_ids or ()))
                    present = present if above.present is None else present & above.present
                columns[plan.signal.name] = SignalColumn(raw, _scaled(plan, raw), present)
        return columns


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
    _place_of(signal, message.length)
    return signal


def _with_multiplexers(message: Message, names: Sequence[str]) -> list[Signal]:
    """Signals, each once and after the multiplexer that it hangs on."""
    ordered: dict[str, Signal] = {}

    def add(name: str) -> None:
        signal = check_decodable(message, name)
        if signal.multiplexer_signal is not None and signal.multiplexer_signal not in ordered:
            add(signal.multiplexer_signal)
        ordered[name] = signal

    for name in names:
        if name not in ordered:
            add(name)
    return list(ordered.values())


# --- bits ---


class _Place(NamedTuple):
    """Eight bytes from `first` on, as one number; `spill` is the count of leading bits to skip.

    spill > 0 only where a signal touches nine bytes, so that no eight hold it.
    """

    first: int
    is_big_endian: bool
    spill: int


def _place_of(signal: Signal, message_length: int) -> tuple[_Place, int]:
    """The word that holds a signal, and the left shift that brings its top bit to bit 63.

    `start` of a DBC is the signal's least significant bit (little endian) or its most significant (big endian), bit 0
    of a byte being the least significant.  Raises ValueError when the signal does not lie within the message.
    """
    start, length, is_big_endian = signal.start, signal.length, signal.byte_order == "big_endian"
    first_bit = 8 * (start // 8) + (7 - start % 8) if is_big_endian else start
    if not (1 <= length <= 64 and first_bit >= 0 and first_bit + length <= 8 * message_length):
        raise ValueError(f"{length} bits from {start} do not lie within {message_length} bytes")
    byte, skip = divmod(first_bit, 8)
    if skip + length > 64:
        return _Place(byte, is_big_endian, skip), 0 if is_big_endian else 64 - length
    first = max(min(byte, message_length - 8), 0)
    inside = first_bit - 8 * first
    return _Place(first, is_big_endian, 0), inside if is_big_endian else 64 - length - inside


def _words(payload: Payload, place: _Place) -> NDArray[np.uint64]:
    """The word of a place in every row of a payload (N, length), as (N,)."""
    block = payload[:, place.first : place.first + 8]
    if block.shape[1] < 8:
        block = np.concatenate([block, np.zeros((len(block), 8 - block.shape[1]), np.uint8)], axis=1)
    words: NDArray[np.uint64] = np.ascontiguousarray(block).view(">u8" if place.is_big_endian else "<u8")[:, 0]
    if not place.spill:
        return words
    ninth = payload[:, place.first + 8].astype(np.uint64)
    if place.is_big_endian:
        return (words << np.uint64(place.spill)) | (ninth >> np.uint64(8 - place.spill))
    return (words >> np.uint64(place.spill)) | (ninth << np.uint64(64 - place.spill))


# --- values ---


@dataclass(frozen=True, slots=True)
class _Plan:
    """How a signal is cut out of a word and scaled.

    `right` is int64 for a signed signal, else uint64, so that the shift keeps the sign; `kind` is "python" where 64
    bits cannot follow Python's integers.
    """

    signal: Signal
    place: _Place
    left: np.uint64
    right: np.int64 | np.uint64
    conversion: BaseConversion
    kind: Literal["identity", "integer", "linear", "python"]


def _plan(message: Message, signal: Signal) -> _Plan:
    place, left = _place_of(signal, message.length)
    conversion = signal.conversion
    if isinstance(conversion, NamedSignalConversion):  # nobody asks for the names
        conversion = BaseConversion.factory(conversion.scale, conversion.offset, None, conversion.is_float)
    is_signed = signal.is_signed and not conversion.is_float
    right = (np.int64 if is_signed else np.uint64)(64 - signal.length)
    return _Plan(signal, place, np.uint64(left), right, conversion, _kind(signal, conversion))


def _kind(signal: Signal, conversion: BaseConversion) -> Literal["identity", "integer", "linear", "python"]:
    if isinstance(conversion, IdentityConversion):
        return "identity"
    if conversion.is_float:
        return "linear" if isinstance(conversion, LinearConversion) else "python"
    low, high = code_limits(signal)
    products = [low * conversion.scale, high * conversion.scale]
    if isinstance(conversion, LinearIntegerConversion):
        numbers = [high, *products, *(p + conversion.offset for p in products), conversion.scale, conversion.offset]
        return "integer" if all(_LIMITS.min <= n <= _LIMITS.max for n in numbers) else "python"
    is_rounded = isinstance(conversion.scale, int) and max(abs(p) for p in products) > _EXACT_FLOAT
    return "linear" if isinstance(conversion, LinearConversion) and not is_rounded else "python"


def _codes(plan: _Plan, words: NDArray[np.uint64]) -> NDArray[Any]:
    """Raw codes (N,) of a signal."""
    top = words << plan.left
    if isinstance(plan.right, np.int64):
        signed: NDArray[np.int64] = top.view(np.int64) >> plan.right
        return signed
    codes: NDArray[np.uint64] = top >> plan.right
    length = plan.signal.length
    if plan.conversion.is_float:
        return codes.astype(_FLOAT_BITS[length]).view(_FLOATS[length]).astype(np.float64)
    return codes if length == 64 else codes.view(np.int64)


def _scaled(plan: _Plan, codes: NDArray[Any]) -> NDArray[Any]:
    """Physical values (N,) of a signal."""
    conversion = plan.conversion
    if plan.kind == "identity":
        return codes
    if plan.kind == "python":
        values = [conversion.raw_to_scaled(code, False) for code in codes.tolist()]
        return np.array(values, np.float64 if isinstance(conversion, LinearConversion) else np.object_)
    if plan.kind == "integer":
        return codes * np.int64(conversion.scale) + np.int64(conversion.offset)
    return codes.astype(np.float64) * float(conversion.scale) + float(conversion.offset)
