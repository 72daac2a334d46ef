"""Tables of decoded signals: their cells (CSV, Parquet), and as recordings the frames of their columns (MF4, too).

rows of cells or channels of MF4 -> Samples (time, value) of each column -> SignalTable.frames(), as of a log
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.can.candump import Frame
from soilbus.can.log_formats import check_mf4_blocks, placed_copy
from soilbus.can.logs import LEAST_STAMPS, MOST_BACKWARDS, LogError
from soilbus.config.model import Columns as TimeColumn
from soilbus.files import LIMITS, opened, packing, plain_bytes, read_all, text_lines
from soilbus.words import did_you_mean, one_line, shown

Columns = Mapping[str, Sequence[Any]]
"""Cells of each column by its name."""

MISSING_CELLS = frozenset({"", "nan", "na", "n/a", "<na>", "null", "none"})
"""Texts, in small letters, of a cell without a value."""
SEPARATORS = ",;\t"
"""Between the cells of a table; a spreadsheet writes semicolons or tabs where the comma is in numbers."""
LEAST_CELL = 8
"""Bytes of a cell in memory at least."""
PACKED = (".gz", ".bz2", ".xz", ".zst")
"""Ends of the names of packed files."""
TIME_NAMES = re.compile(r"t|time|times?tamp|date_?time|date|zeit|uhrzeit|seconds|sekunden|index", re.IGNORECASE)
"""First word of the name of a column of times."""
_TIMES = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9,
    "min": 60.0, "h": 3600.0,
}  # fmt: skip
"""Seconds by the unit of a column of times."""
_DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_DECIMAL_POINT = re.compile(r"[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")


class TableError(LogError):
    """Error of a table that cannot be used; one line says where and why."""


def read_columns(path: Path, needed: Sequence[str] | None) -> Columns:
    """Return the cells of the needed columns of a CSV or Parquet file; of all columns by default.

    TableError where it cannot be read, or a column is missing.
    """
    readers = {".csv": _csv, ".parquet": _parquet, ".pq": _parquet}
    reader = _csv if str(path) == "-" else readers.get(kind_of(path))
    try:
        if reader is None:
            path.stat()  # what is not there has no kind
            raise TableError(f"{path}: not a table: {', '.join(readers)} can be read")
        return reader(path, needed)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror or one_line(error, 100)}") from None


def kind_of(path: Path) -> str:
    """Return the suffix of a file's name in small letters, without that of its packing."""
    ends = [end.lower() for end in path.suffixes]
    return next((end for end in reversed(ends) if end not in PACKED), "")


def _csv(path: Path, needed: Sequence[str] | None) -> Columns:
    try:
        with opened(path) as stream:
            rows, separator = csv_rows(stream, needed or ())
    except (ValueError, csv.Error) as error:
        raise TableError(f"{path}: not CSV text ({one_line(error, 100)})") from None
    if not rows:
        raise TableError(f"{path}: no row in it")
    header = [name.strip() for name in rows[0]]
    needed = header if needed is None else needed
    check_columns(path, header, needed)
    for i, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise TableError(f"{path}: row {i} has {len(row)} cells under a header of {len(header)}")
    places = {name: header.index(name) for name in needed}
    columns = {name: [row[place] for row in rows[1:]] for name, place in places.items()}
    return columns if separator == "," else _with_points(columns)


def csv_rows(stream: Any, names: Collection[str]) -> tuple[list[list[str]], str]:
    """Return the rows of a stream's text that have cells, and the separator of these (see `separator_of`)."""
    lines = text_lines(plain_bytes(BytesIO(read_all(stream))))
    first = next((line for line in lines if line.strip()), "")
    separator = separator_of(first, names)
    return [row for row in csv.reader(chain([first], lines), delimiter=separator, strict=True) if row], separator


def separator_of(header: str, names: Collection[str]) -> str:
    """Return the separator by which most of the names are columns under this header, of several the most frequent one.

    Examples
    --------
    >>> separator_of("log;start, UTC, or none;vehicle", ["log", "vehicle"])
    ';'
    """

    def found(separator: str) -> tuple[int, int]:
        cells = {cell.strip().lower() for row in csv.reader([header], delimiter=separator) for cell in row}
        return len(cells & {name.lower() for name in names}), header.count(separator)

    return max(SEPARATORS, key=found)


def _with_points(columns: dict[str, list[str]]) -> dict[str, list[str]]:
    """The cells with a point in place of each decimal comma.

    A comma is one where no number of the table has a point and some number cannot be one of thousands.
    """
    cells = {cell.strip() for column in columns.values() for cell in column}
    commas = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)]
    if any(map(_DECIMAL_POINT.fullmatch, cells)) or all(map(_THOUSANDS.fullmatch, commas)):
        return columns
    return {
        name: [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell.strip()) else cell for cell in column]
        for name, column in columns.items()
    }


def _parquet(path: Path, needed: Sequence[str] | None) -> Columns:
    try:
        arrow: Any = import_module("pyarrow")  # typed only in part
        parquet: Any = import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise TableError(f"{path}: a Parquet file needs the extra soilbus[tables]") from None
    try:
        with opened(path) as stream:
            source = BytesIO(read_all(stream)) if packing(stream) else path
        with parquet.ParquetFile(source) as file:
            names = file.schema_arrow.names
            needed = names if needed is None else needed
            check_columns(path, names, needed)
            check_cells(file.metadata.num_rows * len(needed))
            table = file.read(columns=list(needed))
    except (arrow.ArrowException, ValueError) as error:
        raise TableError(f"{path}: not a Parquet file that can be read ({one_line(error, 100)})") from None
    return {name: table.column(name).to_pylist() for name in needed}


def check_cells(cells: int) -> None:
    """Raise ValueError where a Parquet file has too many cells for the memory."""
    if cells > LIMITS.whole // LEAST_CELL:
        raise ValueError(f"{cells} cells are too many")


def check_columns(source: Path | str, header: Sequence[str], needed: Sequence[str]) -> None:
    """Raise TableError where a needed column is missing, or there twice."""
    if missing := [name for name in needed if name not in header]:
        raise TableError(f"{source}: no column {', '.join(missing)}; it has {', '.join(header) or 'none'}")
    if twice := list(dict.fromkeys(name for name in needed if header.count(name) > 1)):
        raise TableError(f"{source}: two columns are named {', '.join(twice)}")


def number(cell: Any) -> float:
    """Return the number of a cell; nan where it is missing, inf for what is no finite number."""
    if cell is None or str(cell).strip().lower() in MISSING_CELLS:
        return math.nan
    try:
        value = math.inf if isinstance(cell, bool) else float(cell)
    except (TypeError, ValueError):
        return math.inf
    return value if math.isfinite(value) else math.inf


class Samples(NamedTuple):
    """Times [s] and values (N,) of a column, their order among those of others, and the unit that the file names."""

    t: Array
    value: Array
    order: Array
    unit: str = ""


class SignalTable:
    """A table of decoded signals, read once as the frames of its columns' messages; it stands where a Log stands.

    It is CSV, Parquet or MF4, packed or not, with a column of times; "-" is CSV from standard input. The names of
    columns are in the order of their identifiers.
    """

    note, left_out = "", 0

    def __init__(self, path: Path, time: TimeColumn, names: Sequence[str]) -> None:
        self.path, self._time, self._names, self.span = path, time, names, 0.0
        self.channels: Counter[str] = Counter()
        self.kind = f"table ({kind_of(path).removeprefix('.') or 'csv'})"

    @property
    def name(self) -> str:
        """Name of the table in messages."""
        return "standard input" if str(self.path) == "-" else str(self.path)

    @property
    def chosen(self) -> str:
        """Channel that is read: none, as a table has none."""
        return ""

    def frames(self) -> Iterator[Frame]:
        """Yield a frame for each cell that is not empty; text gives infinity, which is refused and counted.

        TableError where the table cannot be read, or a column is missing or has no number.
        """
        series = read_samples(self.path, self._time, self._names)
        for name, samples in series.items():
            if len(samples.value) and not np.isfinite(samples.value).any() and np.isinf(samples.value).any():
                raise TableError(f"{self.name}: column {shown(name, 80)} holds no number")
        yield from self._merged(list(series.values()))

    def _merged(self, series: Sequence[Samples]) -> Iterator[Frame]:
        present = [~np.isnan(s.value) for s in series]
        t = np.concatenate([s.t[p] for s, p in zip(series, present, strict=True)])
        value = np.concatenate([s.value[p] for s, p in zip(series, present, strict=True)]).astype("<f8")
        order = np.argsort(np.concatenate([s.order[p] for s, p in zip(series, present, strict=True)]), kind="stable")
        number_of = np.repeat(np.arange(len(series)), [int(p.sum()) for p in present])
        if not len(t):
            raise TableError(f"{self.name}: no value in it")
        known = t[np.isfinite(t)]
        self.span = float(known.max() - known.min()) if len(known) else 0.0
        self.channels[""] = len(t)
        data = value[order].tobytes()
        for i, (stamp, column) in enumerate(zip(t[order].tolist(), number_of[order].tolist(), strict=True)):
            yield stamp, column, column >= 1 << 11, data[8 * i : 8 * i + 8], False, False


def read_samples(path: Path, time: TimeColumn, names: Sequence[str] | None = None) -> dict[str, Samples]:
    """Return the samples of a table by column; of all columns with numbers by default.

    TableError where it cannot be read, a column is missing, or the column of times holds none.
    """
    if kind_of(path) == ".mf4":
        return _mf4(path, names)
    if not time.time:
        none = "None is called t, time, timestamp or Zeit; columns.time says it"
        raise TableError(f"{path}: which column is the time? {none}")
    cells = read_columns(path, None if names is None else list(dict.fromkeys([time.time, *names])))
    if time.time not in cells:
        raise TableError(f"{path}: no column {time.time}{did_you_mean(time.time, cells)}")
    units = {name: str(column[0]).strip() for name, column in cells.items() if len(column)}
    first = cells[time.time][0] if units else None
    begin = int(bool(str(first or "").strip()) and math.isinf(number(first)) and seconds_of_date(first) is None)
    t = _times(path, time, cells[time.time][begin:])
    order = np.arange(len(t), dtype=np.float64)
    series = {}
    for name in cells if names is None else names:
        values = np.array([number(cell) for cell in cells[name][begin:]], np.float64)
        if names is not None or (name != time.time and np.isfinite(values).sum() > np.isinf(values).sum()):
            series[name] = Samples(t, values, order, units.get(name, "") if begin else "")
    return series


def time_column(path: Path) -> str:
    """Return the column of a table that its name calls the time; "" without one, and of MF4."""
    if kind_of(path) == ".mf4":
        return ""
    names = list(read_columns(path, None))
    return next((name for name in names if TIME_NAMES.fullmatch(re.split(r"[ _\[(/]", name)[0] or "index")), "")


def seconds_of_date(cell: Any) -> float | None:
    """Return the seconds since 1970 of a date, in UTC where it names no zone; None for what is none."""
    try:
        when = cell if isinstance(cell, datetime) else datetime.fromisoformat(str(cell).strip())
    except ValueError:
        return None
    return float((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp())


def _times(path: Path, time: TimeColumn, cells: Sequence[Any]) -> Array:
    """Times [s], inf where a cell has none; TableError where there is none, or many are before the one before."""
    times = np.array([math.inf if isinstance(cell, datetime) else number(cell) for cell in cells], np.float64)
    if np.isfinite(times).any():
        ending = re.search(r"(?:^|[\[( _/])([a-zµμ]+)[\])]?\s*$", time.time)
        unit = time.unit or (ending[1] if ending and ending[1] in _TIMES else "s")
        times = np.where(np.isfinite(times), times * _TIMES[unit], math.inf)
    else:
        dates = [seconds_of_date(cell) for cell in cells]
        if dates and not any(date is not None for date in dates):
            seen = f"{shown(cells[0], 40)!r} is neither a number nor a date as 2026-05-01T12:00:00.1"
            raise TableError(f"{path}: column {time.time} holds no time: {seen}")
        times = np.array([math.inf if date is None else date for date in dates], np.float64)
    backwards = int((np.diff(times[np.isfinite(times)]) < 0.0).sum())
    if len(times) >= LEAST_STAMPS and backwards > MOST_BACKWARDS * len(times):
        rows = f"{backwards} of {len(times)} rows"
        raise TableError(f"{path}: column {time.time} goes backwards in {rows}: sort them by time")
    return np.asarray(times)


def _mf4(path: Path, names: Sequence[str] | None) -> dict[str, Samples]:
    """The channels of an MF4 file with their own times."""
    try:
        mdf_of: Any = import_module("asammdf").MDF
    except ModuleNotFoundError:
        raise TableError(f"{path}: an MF4 file needs the extra soilbus[mf4]") from None
    try:
        with opened(path) as stream, placed_copy(stream) as copy:
            check_mf4_blocks(copy)
            with mdf_of(copy) as file:
                first = {name: places[0] for name, places in file.channels_db.items()}
                known = {name: (group, at) for name, (group, at) in first.items() if file.masters_db.get(group) != at}
                check_columns(path, list(known), names or ())
                start = file.header.start_time.timestamp()
                found = {name: file.get(name, *known[name]) for name in names or known}
                return {name: _channel(of, start) for name, of in found.items() if of.samples.dtype.kind in "buif"}
    except OSError as error:
        raise TableError(f"{path}: {error.strerror or one_line(error, 100)}") from None
    except LogError:
        raise
    except Exception as error:  # asammdf raises all kinds on a damaged file
        raise TableError(f"{path}: not an MF4 file that can be read ({one_line(error, 100)})") from None


def _channel(signal: Any, start: float) -> Samples:
    t = np.asarray(signal.timestamps, np.float64) + start
    return Samples(t, np.asarray(signal.samples, np.float64), t, str(signal.unit or ""))
