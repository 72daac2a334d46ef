"""The parts of a batch -> its results: windows by vehicle and day, summaries, errors, map.

    windows/vehicle=V/day=D/DIGEST-N.parquet    rows of a piece of one log on one day (UTC), with the same columns
    logs.parquet, vehicles.parquet              counts and means; a row for each log, for each vehicle
    errors.parquet                              logs that failed or were damaged, each with its line
    map.parquet                                 GeoParquet 1.1: a point (WKB, WGS84) for each window with a position

Everything follows from the parts, in the order of vehicle, log and digest: the same parts give the same bytes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from soilbus.export.table import arrow_schema, arrow_table, table_columns
from soilbus.files import whole_file_of_bytes
from soilbus.offline.parts import rows_of_piece
from soilbus.pipeline.outputs import column_names

ROW_GROUP = 2000
"""Rows that are converted at once: 2 MB of columns."""
HIVE_NULL = "__HIVE_DEFAULT_PARTITION__"
"""Name of a folder for what has no value; pandas cannot read it beside others."""
NO_DAY = "unknown"
"""Day of windows whose log has no dates."""
LONGEST_NAME = 255
"""Bytes of a file's name on usual file systems."""
MAP_COLUMNS = (
    "vehicle", "log", "window", "t", "time", "status", "reason", "bearing_pressure.value", "bearing_pressure.std",
    "soil.phi.value", "soil.phi.std", "traversability.state", "traversability.probability",
    "traversability.max_draft.value", "traversability.max_draft.std", "traversability.limit",
)  # fmt: skip
"""Columns of the windows that the map repeats."""
RESULTS = (
    "windows", "logs.parquet", "vehicles.parquet", "errors.parquet", "map.parquet", "diagnosis.json", "effects.parquet",
)  # fmt: skip
"""In a folder of results, what each run writes again."""
ERROR_COLUMNS = ("vehicle", "log", "windows", "fault")
EFFECT_COLUMNS = (
    "configuration", "vehicle", "effect", "scope", "parameter", "value", "std", "probability", "named", "since",
)  # fmt: skip
GEO = {
    "version": "1.1.0",
    "primary_column": "geometry",
    "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Point"]}},
}
"""Metadata `geo` of GeoParquet 1.1; without a `crs` coordinates are longitude and latitude in WGS84 (OGC:CRS84)."""
_WKB_POINT = np.dtype([("order", "u1"), ("kind", "<u4"), ("x", "<f8"), ("y", "<f8")])


def day_files(piece: bytes, columns: Sequence[str]) -> dict[str, bytes]:
    """Return the Parquet files of a piece of a part, by day.

    Parameters
    ----------
    piece
        As parts.pieces_of_part() reads it.
    columns
        Of all windows of the batch.
    """
    import pyarrow.parquet as pq

    schema = arrow_schema(columns)
    files: dict[str, BytesIO] = {}
    writers: dict[str, Any] = {}
    for rows in rows_of_piece(piece, ROW_GROUP):
        days = [_day(row["time"]) for row in rows]
        for day in dict.fromkeys(days):
            if day not in writers:
                files[day] = BytesIO()
                writers[day] = pq.ParquetWriter(files[day], schema)
            writers[day].write_table(arrow_table([r for r, d in zip(rows, days, strict=True) if d == day], schema))
    for writer in writers.values():
        writer.close()
    return {day: file.getvalue() for day, file in files.items()}


def _day(milliseconds: int | None) -> str:
    return NO_DAY if milliseconds is None else datetime.fromtimestamp(milliseconds / 1e3, UTC).date().isoformat()


def window_columns(summaries: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the columns of the windows of all parts; the vehicle is in the folder's name."""
    return [c for c in table_columns(dict.fromkeys(s["columns"]) for s in summaries) if c != "vehicle"]


def folder_of(windows: Path, vehicle: str, day: str) -> Path:
    """Return the folder of a vehicle's windows of one day."""
    return windows / _vehicle_folder(vehicle) / f"day={day}"


def can_be_folder(vehicle: str) -> bool:
    """Return whether a folder can have the name of a vehicle, and readers find it."""
    return vehicle.isprintable() and vehicle != HIVE_NULL and len(_vehicle_folder(vehicle)) <= LONGEST_NAME


def _vehicle_folder(vehicle: str) -> str:
    return f"vehicle={quote(vehicle, safe=' ')}"


def put(path: Path, content: Iterable[bytes]) -> None:
    """Write a file whole or not at all, in a folder that may have to be made; NotWritten."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file_of_bytes(path) as out:
        out.writelines(content)


def replace_folder(new: Path, old: Path) -> None:
    """Let a folder take the place of another."""
    if old.exists():
        shutil.rmtree(old)
    new.rename(old)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> None:
    """Write rows as a Parquet file with units and versions; by default the columns that occur.  NotWritten."""
    import pyarrow.parquet as pq

    out = BytesIO()
    pq.write_table(arrow_table(rows, arrow_schema(columns or table_columns(rows))), out)
    put(path, [out.getvalue()])


def log_rows(summaries: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of logs.parquet: the summaries, with 0 for each reason of refusal that a log lacks."""
    rows = [
        {name: value for name, value in summary.items() if name not in ("columns", "pieces")} for summary in summaries
    ]
    reasons = sorted({name for row in rows for name in row if name.startswith("rejected.")})
    return [row | {reason: row.get(reason, 0) for reason in reasons} for row in rows]


def vehicle_rows(logs: Sequence[Mapping[str, Any]], errors: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of vehicles.parquet.

    Parameters
    ----------
    logs, errors
        Rows of logs.parquet and errors.parquet.

    Returns
    -------
    One row for each vehicle: counts added up, the mean bearing pressure over valid windows, first begin and last end.
    """
    rows = []
    for vehicle, (own, faults) in sorted(_by_vehicle(logs, errors).items()):
        row: dict[str, Any] = {
            "vehicle": vehicle,
            "logs.all": len({str(each["log"]) for each in (*own, *faults)}),
            "logs.failed": sum(not fault["windows"] for fault in faults),
            "logs.damaged": sum(bool(fault["windows"]) for fault in faults),
            "begin": min((each["begin"] for each in own if each["begin"] is not None), default=None),
            "end": max((each["end"] for each in own if each["end"] is not None), default=None),
        }
        for name in column_names(own):
            values = [each[name] for each in own if each.get(name) is not None]
            if name not in row and all(isinstance(value, int | float) for value in values):
                row[name] = sum(values) if values else None
        weights = [(each["bearing_pressure.mean"], each["windows.valid"]) for each in own]
        known = [(mean, n) for mean, n in weights if mean is not None]
        row["bearing_pressure.mean"] = sum(m * n for m, n in known) / sum(n for _, n in known) if known else None
        rows.append({name: value for name, value in row.items() if name not in ("fault", "log", "configuration")})
    return rows


def _by_vehicle(*tables: Sequence[Mapping[str, Any]]) -> dict[str, tuple[list[Mapping[str, Any]], ...]]:
    """The rows of each table that are of one vehicle."""
    found: dict[str, tuple[list[Mapping[str, Any]], ...]] = {}
    for i, rows in enumerate(tables):
        for row in rows:
            found.setdefault(str(row["vehicle"]), tuple([] for _ in tables))[i].append(row)
    return found


def write_map(path: Path, windows: Path) -> int:
    """Write a GeoParquet file of all windows with a position.

    Parameters
    ----------
    path
        File to write.
    windows
        Folder of the windows.

    Returns
    -------
    Number of points; 0 without a file where there is none.

    Raises
    ------
    NotWritten
        The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    files = sorted(windows.rglob("*.parquet"))
    columns = [name for name in MAP_COLUMNS if name == "vehicle" or name in pq.read_schema(files[0]).names]
    plain = arrow_schema(columns)
    schema = plain.append(pa.field("geometry", pa.binary()))
    schema = schema.with_metadata({**plain.metadata, b"geo": json.dumps(GEO).encode()})
    points = 0
    path.unlink(missing_ok=True)
    with whole_file_of_bytes(path) as out, pq.ParquetWriter(out, schema) as writer:
        for file in files:
            batches = pq.ParquetFile(file).iter_batches(ROW_GROUP, columns=[*columns[1:], "longitude", "latitude"])
            for batch in batches:
                placed = batch.filter(pc.is_valid(batch.column("longitude")))
                if placed.num_rows:
                    vehicle = pa.array([_vehicle_of(file)] * placed.num_rows, pa.string())
                    geometry = _points(placed.column("longitude"), placed.column("latitude"))
                    arrays = [vehicle, *(placed.column(name) for name in columns[1:]), geometry]
                    writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
                    points += placed.num_rows
    if not points:
        path.unlink()
    return points


def _vehicle_of(file: Path) -> str:
    return unquote(file.parent.parent.name.removeprefix("vehicle="))


def _points(longitude: Any, latitude: Any) -> Any:
    """Points as a pyarrow array of well-known binary (OGC 06-103r4)."""
    import pyarrow as pa

    points = np.empty(len(longitude), _WKB_POINT)
    points["order"], points["kind"], points["x"], points["y"] = 1, 1, longitude.to_numpy(), latitude.to_numpy()
    return pa.array([point.tobytes() for point in points], pa.binary())
