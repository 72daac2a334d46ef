"""Windows as the rows of a table, in CSV or Parquet.

    window_record -> flat_record -> row          columns are paths: soil.phi.value, slip.FL

Parquet keeps each column's unit in the field's metadata and the versions of schema and soilbus in the file's.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from soilbus import __version__
from soilbus.config.model import Config
from soilbus.export.columns import SCHEMA_VERSION, Kind, column
from soilbus.files import whole_file, whole_file_of_bytes
from soilbus.pipeline.outputs import column_names, flat_record, window_record
from soilbus.pipeline.result import WindowResult

Rows = Sequence[Mapping[str, Any]]


def write_table(path: Path, results: Iterable[WindowResult], config: Config) -> None:
    """Write the windows to a .parquet file, or to a CSV file under any other name.

    Raises
    ------
    NotWritten
        The file cannot be written.
    """
    rows = [flat_record(window_record(result, config)) for result in results]
    if path.suffix == ".parquet":
        with whole_file_of_bytes(path) as binary:
            binary.write(parquet_of(rows))
    else:
        with whole_file(path) as text:
            write_csv(text, rows)


def write_csv(out: Any, rows: Rows) -> None:
    """Write rows with a head of column names; what is not known is an empty cell."""
    writer = csv.DictWriter(out, column_names(rows), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def parquet_of(rows: Rows) -> bytes:
    """The bytes of a Parquet file; what is not known is null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {"text": pa.string(), "number": pa.float64(), "integer": pa.int64(), "truth": pa.bool_()}
    fields, arrays = [], []
    for name in column_names(rows):
        kind, unit = _described(name)
        fields.append(pa.field(name, types[kind], metadata={"unit": unit} if unit else None))
        arrays.append(pa.array([row.get(name) for row in rows], types[kind]))
    metadata = {"soilbus_version": __version__, "soilbus_schema": SCHEMA_VERSION}
    out = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata)), out)
    return out.getvalue()


def _described(name: str) -> tuple[Kind, str]:
    found = column(name)
    assert found is not None, f"{name} is not described in export/columns.py"
    return found
