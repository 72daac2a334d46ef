"""Frames in an MCAP log: JSON messages of schema can_msgs/Frame, on any topic.

The schema has the names of ROS 2's can_msgs, whose `data` ends after `dlc` bytes; a frame of CAN FD has up to 64.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from io import BufferedReader
from typing import Any

import can

from soilbus.can.candump import Frame, Heard, of_message
from soilbus.files import LIMITS, within_ratio

_STAMP = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nanosec": {"type": "integer"}}}
_CHANNEL = {"type": "string", "description": "channel of the bus"}
_PROPERTIES = {
    "header": {"type": "object", "properties": {"stamp": _STAMP, "frame_id": _CHANNEL}},
    "id": {"type": "integer", "description": "identifier, without flags"},
    "is_rtr": {"type": "boolean"},
    "is_extended": {"type": "boolean"},
    "is_error": {"type": "boolean"},
    "dlc": {"type": "integer", "description": "bytes of data"},
    "data": {"type": "array", "items": {"type": "integer"}},
}
FRAME_SCHEMA = {
    "title": "can_msgs/Frame", "type": "object", "properties": _PROPERTIES, "required": list(_PROPERTIES)
}  # fmt: skip


def nanoseconds(t: float) -> int:
    """Return a time [s] in ns; divided by 10**9 it is the same float again."""
    whole = math.floor(t)
    return whole * 10**9 + round((t - whole) * 1e9)


def frame_message(channel: str, frame: Frame) -> dict[str, Any]:
    """Return a frame as a message of FRAME_SCHEMA."""
    t, identifier, is_extended, data, is_remote, is_error = frame
    sec, nanosec = divmod(nanoseconds(t), 10**9)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": channel}, "id": identifier,
        "is_rtr": is_remote, "is_extended": is_extended, "is_error": is_error, "dlc": len(data), "data": list(data),
    }  # fmt: skip


def mcap_frames(stream: BufferedReader) -> Iterator[Heard]:
    """Yield the frames of an MCAP log in the order of the file; ValueError where it has none."""
    try:
        from mcap.records import Channel, Message, Schema
    except ModuleNotFoundError:
        raise ModuleNotFoundError("this format needs soilbus[mcap]") from None
    title = FRAME_SCHEMA["title"]
    schemas, channels, is_empty = set(), set(), True
    for record in _records(stream):
        if isinstance(record, Schema) and record.name == title:
            schemas.add(record.id)
        elif isinstance(record, Channel) and record.schema_id in schemas and record.message_encoding == "json":
            channels.add(record.id)
        elif isinstance(record, Message) and record.channel_id in channels:
            is_empty = False
            yield of_message(_message(record.data))
    if is_empty:
        raise ValueError(f"it has no CAN frames: no JSON message of schema {title}")


def _message(data: bytes) -> can.Message:
    """The frame of a message of FRAME_SCHEMA."""
    if len(data) > LIMITS.line:
        raise ValueError(f"a frame of more than {LIMITS.line} characters")
    said = json.loads(data)
    try:
        header, length = said["header"], said["dlc"]
        return can.Message(
            timestamp=(header["stamp"]["sec"] * 10**9 + header["stamp"]["nanosec"]) / 10**9,
            channel=header["frame_id"], arbitration_id=said["id"], is_extended_id=bool(said["is_extended"]),
            is_remote_frame=bool(said["is_rtr"]), is_error_frame=bool(said["is_error"]), is_fd=length > 8,
            dlc=length, data=said["data"][:length],
        )  # fmt: skip
    except KeyError as name:
        raise ValueError(f"a frame without {name}") from None


def _records(stream: BufferedReader) -> Iterator[Any]:
    """The records of an MCAP log, those of chunks unpacked within LIMITS: the library would unpack any size."""
    import lz4.frame
    import zstandard
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    packed = plain = 0
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=LIMITS.block).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        data = record.data
        if record.compression == "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(data).read(LIMITS.block + 1)
        elif record.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, LIMITS.block + 1)
        if len(data) > LIMITS.block:
            raise ValueError(f"a block of more than {LIMITS.block >> 20} MiB")
        packed, plain = packed + len(record.data), plain + len(data)
        within_ratio(packed, plain)
        yield from breakup_chunk(replace(record, compression="", data=data))
