"""Windows as an MCAP log, for Foxglove, PlotJuggler and every other reader of MCAP; messages are JSON.

    /soilbus/window      one message a window: the keys of `replay --json`, SI units, unit in the schema's descriptions
    /soilbus/location    foxglove.LocationFix, where a position is mapped: the middle of the window's data
    /soilbus/warning     foxglove.Log, one message where a warning of immobilisation began
    /can                 can_msgs/Frame, each frame of the log that was read, so that the file can be replayed

What is not known is absent, not null: plotters take null for a type of its own, and Foxglove refuses a schema that
allows for it.  Times are those of the log [ns].
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any

from soilbus import __version__
from soilbus.can.admission import LAST_TIME
from soilbus.can.candump import Frame
from soilbus.can.mcap_frames import FRAME_SCHEMA, frame_message, nanoseconds
from soilbus.config.model import Config
from soilbus.export.columns import SCHEMA_VERSION, column
from soilbus.files import whole_file_of_bytes
from soilbus.pipeline.outputs import window_record
from soilbus.pipeline.result import WindowResult

JSON_TYPES = {"text": "string", "number": "number", "integer": "integer", "truth": "boolean"}
FOXGLOVE_WARNING = 3
"""Level WARNING of foxglove.Log."""
_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_TEXT = {"type": "string"}


def _schema(title: str, optional: str, **properties: dict[str, str]) -> dict[str, Any]:
    """The JSON schema of a message of Foxglove, of whose properties all but one must be there."""
    known = {"timestamp": _TIME, **properties}
    return {"title": title, "type": "object", "properties": known, "required": [n for n in known if n != optional]}


LOCATION_SCHEMA = _schema(
    "foxglove.LocationFix", "frame_id", frame_id=_TEXT,
    latitude={"type": "number", "description": "deg, positive north"},
    longitude={"type": "number", "description": "deg, positive east"},
)  # fmt: skip
LOG_SCHEMA = _schema("foxglove.Log", "name", level={"type": "integer"}, message=_TEXT, name=_TEXT)


def write_mcap(
    path: Path, results: Sequence[WindowResult], config: Config, frames: Iterable[tuple[str, Frame]] = ()
) -> None:
    """Write the windows in the order of their times, and between them frames, each with its channel, in theirs.

    Raises
    ------
    NotWritten
        The file cannot be written.
    """
    from mcap.writer import Writer

    records = [_without_unknowns(window_record(result, config)) for result in results]
    with whole_file_of_bytes(path) as out:
        writer: Any = Writer(out)
        writer.start(library=f"soilbus {__version__}")
        writer.add_metadata("soilbus", {"version": __version__, "schema": SCHEMA_VERSION})
        topics = {"/soilbus/window": window_schema(records), "/soilbus/location": LOCATION_SCHEMA}
        topics |= {"/soilbus/warning": LOG_SCHEMA, "/can": FRAME_SCHEMA}
        channels = {}
        for topic, schema in topics.items():
            schema_id = writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            channels[topic] = writer.register_channel(topic, "json", schema_id)
        messages = [m for result, record in zip(results, records, strict=True) for m in _messages(result, record)]
        timed = ((channel, frame) for channel, frame in frames if -LAST_TIME <= frame[0] <= LAST_TIME)
        logged = ((frame[0], "/can", frame_message(channel, frame)) for channel, frame in timed)
        in_order = merge(logged, sorted(messages, key=_time_of), key=_time_of)
        for n, (t, topic, message) in enumerate(in_order):
            stamp = max(nanoseconds(t), 0)
            writer.add_message(channels[topic], stamp, json.dumps(message).encode(), stamp, n)
        writer.finish()


_Message = tuple[float, str, Mapping[str, Any]]
"""Time [s], topic and content."""
_time_of: Callable[[_Message], float] = itemgetter(0)


def _messages(result: WindowResult, record: Mapping[str, Any]) -> Iterator[_Message]:
    """What one window says."""
    yield result.t, "/soilbus/window", record
    if result.position is not None:
        latitude, longitude = (math.degrees(angle) for angle in result.position)
        fix = {"timestamp": _time(result.t), "frame_id": "vehicle", "latitude": latitude, "longitude": longitude}
        yield result.t, "/soilbus/location", fix
    for t in result.warnings.begun:
        text = "warning of immobilisation: stop, lift the implement or turn off, and do not add torque"
        warning = {"timestamp": _time(t), "level": FOXGLOVE_WARNING, "message": text, "name": "soilbus"}
        yield t, "/soilbus/warning", warning


def window_schema(records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the JSON schema of all the records: each key that occurs, with its type and, as description, its unit."""
    schema: dict[str, Any] = {"title": "soilbus.Window", "type": "object", "properties": {}}
    for record in records:
        for key, value in record.items():
            _describe(schema["properties"], key, key, value)
    return schema


def _describe(properties: dict[str, Any], key: str, path: str, value: Any) -> None:
    if isinstance(value, Mapping):
        inner = properties.setdefault(key, {"type": "object", "properties": {}})["properties"]
        for name, part in value.items():
            _describe(inner, name, f"{path}.{name}", part)
    elif isinstance(value, list):
        properties[key] = {"type": "array", "items": _leaf(f"{path}.0")}
    else:
        properties[key] = _leaf(path)


def _leaf(path: str) -> dict[str, Any]:
    found = column(path)
    assert found is not None, f"{path} is not described in export/columns.py"
    return {"type": JSON_TYPES[found.kind]} | ({"description": found.unit} if found.unit else {})


def _without_unknowns(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record without its keys of value None."""
    known = ((key, value) for key, value in record.items() if value is not None)
    return {key: _without_unknowns(value) if isinstance(value, Mapping) else value for key, value in known}


def _time(t: float) -> dict[str, int]:
    sec, nsec = divmod(max(nanoseconds(t), 0), 10**9)
    return {"sec": sec, "nsec": nsec}
