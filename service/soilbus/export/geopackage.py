"""The soil map as a GeoPackage (OGC 12-128): GDAL converts the GeoJSON, so both hold the same points and properties."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import numpy as np

from soilbus.files import whole_file_of_bytes

LAYER = "soil"
UTC = 100
"""GDAL's code of that time zone."""


def write_geopackage(path: Path, geojson: str) -> None:
    """Write the points of a FeatureCollection as layer `soil`, in EPSG:4326; NotWritten."""
    from pyogrio.raw import read, write

    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports its success
    meta, _, geometry, columns = read(io.BytesIO(geojson.encode()))
    times = {name: np.full(len(c), UTC) for name, c in zip(meta["fields"], columns, strict=True) if c.dtype.kind == "M"}
    out = io.BytesIO()
    write(
        out, geometry, columns, meta["fields"],
        layer=LAYER, driver="GPKG", geometry_type="Point", crs="EPSG:4326", gdal_tz_offsets=times,
    )  # fmt: skip
    with whole_file_of_bytes(path) as binary:
        binary.write(out.getvalue())
