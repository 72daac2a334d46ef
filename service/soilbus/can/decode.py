"""A message's signals decoded as columns, a whole window of frames at once.

    payload (N, length) -> bits (N, signal's length) -> raw codes (N,) -> physical values (N,)

Every value equals that of `cantools.database.can.Message.decode(..., decode_choices=False)` as a 64-bit float.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

Payload = NDArray[np.uint8]

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}


class SignalColumn(NamedTuple):
    """Values of one signal in N frames.

    `raw` (N,): codes, int64 (uint64 for 64 unsigned bits, float64 for float signals).
    `physical` (N,): scaled values, float64; the codes themselves where nothing is scaled.  `present` (N,): False where
    the multiplexer leaves the signal out and both others are meaningless; None when the signal is in every frame.
    """

    raw: NDArray[Any]
    physical: NDArray[Any]
    present: NDArray[np.bool_] | None


class ColumnDecoder:
    """Decoder of the named signals of one message, and of the multiplexers they hang on.

    Raises KeyError for a signal that is not in the message and ValueError for one that cannot be cut out.
    """

    def __init__(self, message: Message, signals: Sequence[str]) -> None:
        ordered: dict[str, Signal] = {}  # each once and after the multiplexer that it hangs on
        for name in signals:
            chain = [check_decodable(message, name)]
            while (above := chain[-1].multiplexer_signal) is not None:
                chain.append(check_decodable(message, above))
            ordered |= {signal.name: signal for signal in reversed(chain)}
        self._placed = [(signal, _first_bit(signal, message.length)) for signal in ordered.values()]

    def columns(self, payload: Payload) -> dict[str, SignalColumn]:
        """Return the values of the signals, and of those they hang on, by name; payload (N, message length)."""
        columns: dict[str, SignalColumn] = {}
        with np.errstate(over="ignore", invalid="ignore"):  # a signalling nan is still only a nan
            for signal, first_bit in self._placed:
                raw = _codes(payload, signal, first_bit)
                present: NDArray[np.bool_] | None = None
                if signal.multiplexer_signal is not None:  # whose own presence is known already
                    above = columns[signal.multiplexer_signal]
                    present = np.isin(above.physical, list(signal.multiplexer_ids or ()))
                    present = present if above.present is None else present & above.present
                scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
                physical = raw if (scale, offset) == (1.0, 0.0) else raw.astype(np.float64) * scale + offset
                columns[signal.name] = SignalColumn(raw, physical, present)
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
    _first_bit(signal, message.length)
    return signal


def _first_bit(signal: Signal, message_length: int) -> int:
    """The place of a signal's first bit in its own byte order; a DBC counts the bits of a byte from the least one."""
    start, length = signal.start, signal.length
    first = 8 * (start // 8) + (7 - start % 8) if signal.byte_order == "big_endian" else start
    if not (1 <= length <= 64 and first >= 0 and first + length <= 8 * message_length):
        raise ValueError(f"{length} bits from {start} do not lie within {message_length} bytes")
    return first


def _codes(payload: Payload, signal: Signal, first: int) -> NDArray[Any]:
    """Raw codes (N,) of a signal: its bits, filled up to 64 by zeros or by its sign."""
    order: Literal["big", "little"] = "big" if signal.byte_order == "big_endian" else "little"
    is_float, length = signal.conversion.is_float, signal.length
    bits = np.unpackbits(payload[:, first // 8 : (first + length + 7) // 8], axis=1, bitorder=order)
    bits = bits[:, first % 8 : first % 8 + length]
    words = np.zeros((len(payload), 64), np.uint8)
    if signal.is_signed and not is_float:
        words[:] = bits[:, :1] if order == "big" else bits[:, -1:]
    words[:, slice(64 - length, 64) if order == "big" else slice(length)] = bits
    codes = np.packbits(words, axis=1, bitorder=order).view(">u8" if order == "big" else "<u8")[:, 0].astype(np.uint64)
    if is_float:
        return codes.astype(np.dtype(f"u{length // 8}")).view(_FLOATS[length]).astype(np.float64)
    return codes if length == 64 and not signal.is_signed else codes.view(np.int64)
