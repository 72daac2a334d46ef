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
from soilbus.export.columns import SCHEMA_VERSION, Kind, column, is_part
from soilbus.files import whole_file, whole_file_of_bytes
from soilbus.pipeline.outputs import column_names, flat_record, window_record
from soilbus.pipeline.result import WindowResult
from soilbus.words import shown

Rows = Sequence[Mapping[str, Any]]
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a text that spreadsheets take for a formula (OWASP, CSV injection)."""


def write_table(path: Path, results: Iterable[WindowResult], config: Config) -> None:
    """Write the windows to a .parquet file, or to a CSV file under any other name; NotWritten."""
    rows = [flat_record(window_record(result, config)) for result in results]
    if path.suffix == ".parquet":
        with whole_file_of_bytes(path) as binary:
            binary.write(parquet_of(rows))
    else:
        with whole_file(path) as text:
            write_csv(text, rows)


def write_csv(out: Any, rows: Rows) -> None:
    """Write rows with a head of column names; what is not known is an empty cell."""
    columns = table_columns(rows)
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(row.get(name)) for name in columns} for row in rows)


def _cell(value: Any) -> Any:
    """A text as `shown`, with an apostrophe before what a spreadsheet would compute; another value as it is."""
    return "'" * value.startswith(FORMULA) + shown(value) if isinstance(value, str) else value


def parquet_of(rows: Rows, columns: Iterable[str] = ()) -> bytes:
    """Return the bytes of a Parquet file, by default of the columns that occur; what is not known is null."""
    return parquet_bytes(arrow_table(rows, columns))


def parquet_bytes(table: Any) -> bytes:
    """Return the bytes of a Parquet file of a pyarrow table."""
    import pyarrow.parquet as pq

    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def joined(tables: Iterable[Any]) -> Any:
    """Return pyarrow tables one below the other as one; what a table lacks is null."""
    import pyarrow as pa

    return pa.concat_tables(tables, promote_options="default")


def table_columns(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the columns of a table of these rows, without parts that are null in all of them."""
    return [name for name in column_names(rows) if not is_part(name)]


def arrow_schema(names: Iterable[str]) -> Any:
    """Return the pyarrow schema of these columns, each with its unit, and with the versions of schema and soilbus."""
    import pyarrow as pa

    types = {
        "text": pa.string(), "number": pa.float64(), "integer": pa.int64(), "truth": pa.bool_(),
        "time": pa.timestamp("ms", tz="UTC"),
    }  # fmt: skip
    described = ((name, *_described(name)) for name in names)
    fields = [pa.field(name, types[kind], metadata={"unit": unit} if unit else None) for name, kind, unit in described]
    return pa.schema(fields, metadata={"soilbus_version": __version__, "soilbus_schema": SCHEMA_VERSION})


def arrow_table(rows: Rows, columns: Iterable[str] = ()) -> Any:
    """Return a pyarrow table of rows, by default of the columns that occur; null where a row has no such value."""
    import pyarrow as pa

    schema = arrow_schema(columns or table_columns(rows))
    arrays = [pa.array([_as_utf8(row.get(f.name)) for row in rows], f.type) for f in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def _as_utf8(value: Any) -> Any:
    """A text that is no UTF-8, as the name of a file may be, with its codes shown; another value as it is."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def _described(name: str) -> tuple[Kind, str]:
    found = column(name)
    assert found is not None, f"{name} is not described in export/columns.py"
    return found
