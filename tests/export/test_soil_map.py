"""The map of a simulated drive: RFC 7946 by its text, and as GDAL reads it (which is what QGIS opens it with)."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pyogrio
import pytest

from soilbus.cli.main import main
from soilbus.decision.traversability import Status, Traversability
from soilbus.estimation.posterior import Estimate
from soilbus.export.soil_map import soil_map
from soilbus.pipeline.estimator import WindowResult
from soilbus.pipeline.positions import Position
from soilbus.simulator.course import course, positions
from soilbus.simulator.frames import START_TIME
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import TRACTOR, reference_configuration

WAY = course((-17.0, 179.99995), 60.0, (12.0, 3.0))  # a field in Fiji, on both sides of the antimeridian
SECONDS = 26.0
VEHICLE_POSITION = "18FEF31C#"
DEGREE = 111_195.0  # metres


@pytest.fixture(scope="module")
def drive():
    return simulate(reference_configuration(), scenario_over(["loam"], SECONDS, WAY), seed=3)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("map") / "drive.log"
    start = ["--start", "-17", "179.99995", "--heading", "60", "--rows", "12", "3"]
    assert main(["simulate", "--seed", "3", "--duration", str(SECONDS), *start, "--log", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def collection(log) -> dict:
    out = log.with_suffix(".geojson")
    json_out = log.with_suffix(".jsonl")
    assert main(["replay", "--config", str(TRACTOR), str(log), "--map", str(out), "--json", str(json_out)]) == 0
    return json.loads(out.read_text(encoding="utf-8"), parse_constant=pytest.fail)  # no NaN, no Infinity


def test_it_is_a_collection_of_points(collection):
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection  # gone with RFC 7946: always WGS84
    assert len(collection["features"]) == 16
    for feature in collection["features"]:
        assert set(feature) == {"type", "id", "geometry", "properties"}
        assert (feature["type"], feature["geometry"]["type"]) == ("Feature", "Point")
        longitude, latitude = feature["geometry"]["coordinates"]
        assert abs(longitude) <= 180.0
        assert latitude == pytest.approx(-17.0, abs=0.001)
    assert len({f["id"] for f in collection["features"]}) == len(collection["features"])


def test_points_are_where_the_tractor_was_in_the_middle_of_the_window(collection, drive):
    truth = drive.truth
    sides = set()
    for feature in collection["features"]:
        middle = feature["properties"]["t"] - START_TIME - 5.0
        latitude, longitude = positions(WAY, np.interp([middle], truth["t"], truth["distance"]))
        east, north = feature["geometry"]["coordinates"]
        sides.add(east > 0.0)
        # rows are turned through half circles of 1.5 m, which a line over two seconds cuts short
        assert (north - math.degrees(latitude[0])) * DEGREE == pytest.approx(0.0, abs=0.45)
        off = (east - math.degrees(longitude[0]) + 180.0) % 360.0 - 180.0
        assert off * DEGREE * math.cos(math.radians(17.0)) == pytest.approx(0.0, abs=0.45)
    assert sides == {True, False}


def test_at_a_border_each_soil_is_drawn_on_its_own_side(tmp_path):
    """Windows across the border tell the new soil from what lies behind it, so that is where their points are."""
    log, out = tmp_path / "a.log", tmp_path / "m"
    soils = ["--soil", "loam", "--soil", "wet_clay"]
    assert main(["simulate", "--seed", "3", "--duration", "28", *soils, "--start", "52", "13", "--log", str(log)]) == 0
    assert main(["replay", "--config", str(TRACTOR), str(log), "--map", str(out)]) == 0
    border = 14.0 * 1.4  # metres driven north
    sides = {"sandy_loam_15": [], "xi_wet_clay": []}
    for feature in json.loads(out.read_text())["features"]:
        side = sides.get(feature["properties"]["soil_class"])
        if side is not None and feature["properties"]["status"] == "valid":
            side.append((feature["geometry"]["coordinates"][1] - 52.0) * DEGREE)
    loam, clay = sides.values()
    assert min(len(loam), len(clay)) >= 3
    assert max(loam) < border + 1.0
    assert min(clay) > border


def test_properties_are_those_of_the_json_in_the_units_that_they_name(collection, log):
    windows = [json.loads(line) for line in log.with_suffix(".jsonl").read_text().splitlines()]
    for feature, window in zip(collection["features"], windows, strict=True):
        said = feature["properties"]
        assert (said["t"], said["window"], said["status"]) == (window["t"], window["window"], window["status"])
        assert said["bearing_pressure_kpa"] == pytest.approx(window["bearing_pressure"]["value"] / 1e3)
        assert said["bearing_pressure_std_kpa"] == pytest.approx(window["bearing_pressure"]["std"] / 1e3)
        assert math.radians(said["phi_deg"]) == pytest.approx(window["soil"]["phi"]["value"])
        assert math.radians(said["phi_std_deg"]) == pytest.approx(window["soil"]["phi"]["std"])
        assert said["state"] == window["traversability"]["state"]
        assert said["soil_class"] == next(iter(window["soil_class"])) == "sandy_loam_15"
        assert said["soil_class_probability"] == window["soil_class"]["sandy_loam_15"]
        assert {"unknown"} < set(window["soil_class"])
        assert len(window["soil_class"]) == 4
    assert collection["features"][0]["properties"]["time"].startswith("2023-11-14T22:13:29.99")


def test_gdal_opens_it_as_a_layer_of_points_in_wgs84(collection, log):
    path = log.with_suffix(".geojson")
    info = pyogrio.read_info(path)
    assert (info["driver"], info["geometry_type"], info["crs"]) == ("GeoJSON", "Point", "EPSG:4326")
    assert info["features"] == len(collection["features"])
    types = dict(zip(info["fields"].tolist(), info["dtypes"].tolist(), strict=True))
    assert types["bearing_pressure_kpa"] == types["phi_std_deg"] == "float64"
    assert types["time"].startswith("datetime64")
    assert types["state"] == "object"
    meta, _, geometry, columns = pyogrio.raw.read(path)
    values = dict(zip(meta["fields"].tolist(), columns, strict=True))
    x, y = np.array([np.frombuffer(wkb, "<f8", 2, offset=5) for wkb in geometry]).T
    assert [[*pair] for pair in zip(x, y, strict=True)] == [
        f["geometry"]["coordinates"] for f in collection["features"]
    ]
    assert values["phi_deg"].tolist() == [f["properties"]["phi_deg"] for f in collection["features"]]


def test_a_geopackage_holds_the_same_points(collection, log):
    path = log.with_suffix(".gpkg")
    assert main(["replay", "--config", str(TRACTOR), str(log), "--map", str(path)]) == 0
    info = pyogrio.read_info(path)
    assert (info["driver"], info["geometry_type"], info["crs"]) == ("GPKG", "Point", "EPSG:4326")
    meta, _, geometry, columns = pyogrio.raw.read(path, layer="soil")
    points = [[*struct.unpack_from("<dd", wkb, 5)] for wkb in geometry]
    assert points == [f["geometry"]["coordinates"] for f in collection["features"]]
    values = dict(zip(meta["fields"].tolist(), columns, strict=True))
    said = [f["properties"] for f in collection["features"]]
    assert set(values) == set(said[0])
    for name in ("bearing_pressure_kpa", "phi_deg", "state", "soil_class", "max_draft_std_n"):
        assert values[name].tolist() == [properties[name] for properties in said]
    assert str(values["time"][0]) == said[0]["time"].removesuffix("+00:00")


def test_windows_without_a_position_are_left_out_and_counted(log, tmp_path, capsys):
    lines = log.read_text().splitlines(keepends=True)
    gap = [i for i in lines if not (VEHICLE_POSITION in i and START_TIME + 8.3 < float(i[1:18]) < START_TIME + 11.7)]
    (tmp_path / "gap.log").write_text("".join(gap))
    capsys.readouterr()
    assert main(["replay", "--config", str(TRACTOR), str(tmp_path / "gap.log"), "--map", str(tmp_path / "m")]) == 0
    features = json.loads((tmp_path / "m").read_text())["features"]
    middles = [round(f["properties"]["t"] - START_TIME - 5.0) for f in features]
    assert middles == [5, 6, 7, 8, *range(12, 21)]
    assert [f["properties"]["status"] for f in features] == ["valid"] * len(features)  # a position is no needed input
    assert capsys.readouterr().err == "soilbus: 3 of 16 windows have no position: not on the map\n"


def test_without_a_mapped_position_there_is_no_map(log, tmp_path, capsys):
    text = TRACTOR.read_text(encoding="utf-8")
    bare = "\n".join(line for line in text.splitlines() if not line.startswith(("latitude", "longitude")))
    (tmp_path / "bare.toml").write_text(bare, encoding="utf-8")
    arguments = ["replay", "--config", str(tmp_path / "bare.toml"), str(log), "--map", str(tmp_path / "m")]
    assert main(arguments) == 2
    assert capsys.readouterr().err == "soilbus: --map needs a position: map signals.latitude and signals.longitude\n"
    assert not (tmp_path / "m").exists()


def result(**changes) -> WindowResult:
    known = {
        "t": 1_700_000_010.0, "index": 7, "status": Status.INVALID, "reason": "no_convergence", "posterior": None,
        "bearing": None, "slip": {}, "sinkage": {}, "traversability": Traversability(), "chi2": None, "samples": 0,
        "rejected": {}, "position": Position(math.radians(52.0), math.radians(-13.0)),
    }  # fmt: skip
    return WindowResult(**known | changes)


def test_what_is_not_known_is_null_and_never_a_nan():
    strange = result(bearing=Estimate(math.nan, math.inf), t=1e18, soil_class={"unknown": math.nan})
    text, left_out = soil_map([result(), strange, result(position=None)])
    assert left_out == 1
    first, second = json.loads(text, parse_constant=pytest.fail)["features"]
    assert first["geometry"]["coordinates"] == [-13.0, 52.0]
    unknown = ("bearing_pressure_kpa", "phi_deg", "phi_std_deg", "soil_class", "probability", "max_draft_n", "limit")
    assert all(first["properties"][name] is None for name in unknown)
    assert (first["properties"]["status"], first["properties"]["state"]) == ("invalid", "unknown")
    assert second["properties"]["bearing_pressure_kpa"] is second["properties"]["bearing_pressure_std_kpa"] is None
    assert second["properties"]["time"] is None


def test_an_empty_map_is_still_a_collection():
    text, left_out = soil_map([result(position=None)])
    assert (json.loads(text), left_out) == ({"type": "FeatureCollection", "features": []}, 1)
