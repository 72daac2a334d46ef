"""The parts of a batch -> its results: windows by vehicle and day, summaries, errors, map.

    windows/vehicle=V/day=D/part-N.parquet       rows of one day (UTC), with the same columns in all files
    logs.parquet, vehicles.parquet              counts and means; a row for each log, for each vehicle
    errors.parquet                              logs that failed or were damaged, each with its line
    map.parquet                                 GeoParquet 1.1: a point (WKB, WGS84) for each window with a position

Everything follows from the parts, in the order of vehicle, log and digest: the same parts give the same bytes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from soilbus.export.table import arrow_schema, table_columns
from soilbus.files import whole_file_of_bytes
from soilbus.grouping import grouped
from soilbus.offline.cluster import BatchError
from soilbus.offline.parts import ROW_GROUP
from soilbus.pipeline.outputs import column_names
from soilbus.words import one_line

MOST_OPEN = 32
"""Files of vehicles and days that are open at once: those of a vehicle's log, as parts come vehicle by vehicle."""
HIVE_NULL = "__HIVE_DEFAULT_PARTITION__"
"""Name of a folder for what has no value; pandas cannot read it beside others."""
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
"""A point as well-known binary (OGC 06-103r4)."""


def can_be_folder(vehicle: str) -> bool:
    """Return whether a folder can have the name of a vehicle, and readers find it."""
    return vehicle.isprintable() and vehicle != HIVE_NULL and len(f"vehicle={quote(vehicle, safe='')}") <= LONGEST_NAME


def put(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, in a folder that may have to be made; NotWritten."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file_of_bytes(path) as out:
        out.write(content)


def write_windows(out: Path, parts: Sequence[Path]) -> None:
    """Write the windows of all parts as tables by vehicle and day, and the map of them; nothing without parts.

    BatchError where a part cannot be read or a table not be written, NotWritten for the map.
    """
    import pyarrow as pa
    import pyarrow.dataset as ds
    import pyarrow.parquet as pq

    new, windows, chart = out / ".windows", out / "windows", out / "map.parquet"
    shutil.rmtree(new, ignore_errors=True)  # of a run that was stopped
    try:
        names = table_columns(dict.fromkeys(pq.read_schema(part).names) for part in parts)
        rows = ds.dataset(list(map(str, parts)), arrow_schema(names), "parquet")
        if parts:
            folders = ds.partitioning(pa.schema([("vehicle", pa.string()), ("day", pa.string())]), flavor="hive")
            ds.write_dataset(
                rows.to_batches(), new, format="parquet", schema=rows.schema, partitioning=folders, use_threads=False,
                max_open_files=MOST_OPEN, min_rows_per_group=ROW_GROUP, max_rows_per_group=ROW_GROUP,
            )  # fmt: skip
        _write_map(chart, rows)
    except (pa.ArrowException, OSError) as error:
        raise BatchError(f"{out}: the parts cannot be made into tables ({one_line(error, 300)})") from None
    shutil.rmtree(windows, ignore_errors=True)
    if parts:
        new.rename(windows)


def log_rows(summaries: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of logs.parquet: the summaries, with 0 for each reason of refusal that a log lacks."""
    rows = list(summaries)
    reasons = sorted({name for row in rows for name in row if name.startswith("rejected.")})
    return [{**row, **{reason: row.get(reason, 0) for reason in reasons}} for row in rows]


def vehicle_rows(logs: Sequence[Mapping[str, Any]], errors: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of vehicles.parquet from those of logs.parquet and errors.parquet.

    Counts are added up; with them stand the mean bearing pressure over valid windows, the first begin and the last end.
    """
    rows = []
    logs_of, errors_of = (grouped(table, lambda each: str(each["vehicle"])) for table in (logs, errors))
    for vehicle in sorted(logs_of.keys() | errors_of.keys()):
        own, faults = logs_of.get(vehicle, []), errors_of.get(vehicle, [])
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


def _write_map(path: Path, rows: Any) -> None:
    """Write a GeoParquet file of all windows with a position; none where there is none."""
    import pyarrow as pa
    import pyarrow.dataset as ds
    import pyarrow.parquet as pq

    path.unlink(missing_ok=True)
    columns = [name for name in MAP_COLUMNS if name in rows.schema.names]
    if "longitude" not in rows.schema.names or not rows.count_rows(filter=ds.field("longitude").is_valid()):
        return
    plain = arrow_schema(columns)
    schema = plain.append(pa.field("geometry", pa.binary()))
    schema = schema.with_metadata({**plain.metadata, b"geo": json.dumps(GEO).encode()})
    batches = rows.to_batches([*columns, "longitude", "latitude"], filter=ds.field("longitude").is_valid())
    with whole_file_of_bytes(path) as out, pq.ParquetWriter(out, schema) as writer:
        for batch in batches:
            points = np.empty(len(batch), _WKB_POINT)
            points["order"], points["kind"] = 1, 1
            points["x"], points["y"] = (batch.column(name).to_numpy() for name in ("longitude", "latitude"))
            geometry = pa.array([point.tobytes() for point in points], pa.binary())
            arrays = [*(batch.column(name) for name in columns), geometry]
            writer.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))
