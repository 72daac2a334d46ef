"""True values of a simulated drive as a table: CSV, or Parquet with the extra `tables`.

One row an instant (50 a second), SI units, the columns of `drive.Drive` and in front their time stamp on the bus.
"""

from __future__ import annotations

import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.files import whole_file, whole_file_of_bytes
from soilbus.simulator.drive import Drive

__all__ = ["write_truth"]


def write_truth(done: Drive, path: Path, start: float) -> None:
    """Write the true values of a drive.

    Parameters
    ----------
    done
        The drive.
    path
        Of a .parquet file, or of a CSV file under any other name.
    start
        Stamp of the first instant [s].

    Raises
    ------
    NotWritten
        The table cannot be written.
    """
    whole = done.columns | {"t": start + done.columns["t"]}
    columns = {name: of for name, of in whole.items() if of.dtype.kind != "f" or np.isfinite(of).any()}
    if path.suffix == ".parquet":
        arrow: Any = import_module("pyarrow")  # typed only in part
        with whole_file_of_bytes(path) as binary:
            import_module("pyarrow.parquet").write_table(arrow.table(columns), binary)
        return
    with whole_file(path) as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(columns)
        rows.writerows(zip(*(_texts(column) for column in columns.values()), strict=True))


def _texts(column: NDArray[Any]) -> list[str]:
    """Numbers with 13 digits, nan as an empty field."""
    if column.dtype.kind != "f":
        return [str(value) for value in column]
    return ["" if np.isnan(value) else f"{value:.13g}" for value in column.tolist()]
