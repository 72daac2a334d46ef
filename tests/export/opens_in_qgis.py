"""Does QGIS open a soil map as is?  `QT_QPA_PLATFORM=offscreen /usr/bin/python3 tests/export/opens_in_qgis.py MAP`.

On demand, with Debian's python3-qgis: too heavy for every run of CI, where GDAL, by which QGIS
reads, is asked instead (test_soil_map.py).
"""

from __future__ import annotations

import sys

from qgis.core import Qgis, QgsApplication, QgsVectorLayer, QgsWkbTypes


def main(path: str) -> int:
    """Print what QGIS makes of the file; 1 where it is not a layer of points in WGS 84 with features."""
    application = QgsApplication([], False)
    application.initQgis()
    layer = QgsVectorLayer(path, "soil", "ogr")
    geometry = QgsWkbTypes.displayString(layer.wkbType())
    print(f"QGIS {Qgis.version()}: {layer.featureCount()} features, {geometry}, {layer.crs().authid()}")
    print(", ".join(f"{field.name()} {field.typeName()}" for field in layer.fields()))
    good = layer.isValid() and layer.featureCount() > 0 and geometry == "Point" and layer.crs().authid() == "EPSG:4326"
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
