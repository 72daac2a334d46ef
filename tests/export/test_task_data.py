"""ISOXML task data: read by the peer library `isoxml`, its time log taken apart by the standard's layout."""

import json
import math
import re
import shutil
import struct
import subprocess
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import Enum
from pathlib import Path
from xml.etree import ElementTree

import isoxml.models.base.v4 as iso
import pytest
from isoxml.util.isoxml_io import isoxml_from_path
from xsdata.formats.dataclass.parsers import XmlParser
from xsdata.formats.dataclass.parsers.config import ParserConfig

from soilbus.config.model import Config
from soilbus.decision.traversability import Status
from soilbus.estimation.posterior import Estimate
from soilbus.export.task_data import compaction_code, write_task_data

ISOXML_JS = Path(__file__).parent / "read_isoxml.js"


@pytest.fixture
def folder(windows, config, tmp_path) -> Path:
    assert write_task_data(tmp_path / "TASKDATA", windows, config) == 0
    return tmp_path / "TASKDATA"


def faults(element, path: str = "") -> list[str]:
    """What of an element breaks the limits of the standard's schema, which the peer's classes carry."""
    found = []
    for field in fields(element):
        value, limits, here = getattr(element, field.name), field.metadata, f"{path}.{field.name}"
        if isinstance(value, list):
            found += [fault for part in value for fault in faults(part, here)]
        elif is_dataclass(value):
            found += faults(value, here)
        elif value is None:
            found += [f"{here} is missing"] * bool(limits.get("required"))
        elif not isinstance(value, Enum):
            text = value.hex() if isinstance(value, bytes) else str(value)
            found += [f"{here}: {text}"] * (
                ("pattern" in limits and not re.fullmatch(limits["pattern"], text))
                or ("max_length" in limits and _length(field.name, value) > limits["max_length"])
                or ("length" in limits and _length(field.name, value) != limits["length"])
                or ("max_inclusive" in limits and value > limits["max_inclusive"])
                or ("min_inclusive" in limits and value < limits["min_inclusive"])
            )
    return found


def _length(name: str, value: str | bytes) -> int:
    """In characters, or in octets of what is written in hexadecimal."""
    return len(value) // 2 if isinstance(value, str) and name.endswith("_label") else len(value)


def read_by_isoxml_js(folder: Path) -> dict:
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", "require('isoxml')"], capture_output=True).returncode:
        pytest.skip("node or its package isoxml is not here: npm install isoxml, and NODE_PATH=…/node_modules")
    return json.loads(subprocess.run([node, ISOXML_JS, folder], capture_output=True, check=True, text=True).stdout)


def records(folder: Path) -> list[dict]:
    """The time log by ISO 11783-10, annex D: time, position, count, then number and value of each entry."""
    head = ElementTree.parse(folder / "TLG00001.xml").getroot()
    ddis = [int(entry.get("A"), 16) for entry in head.iter("DLV")]
    data, at, found = (folder / "TLG00001.bin").read_bytes(), 0, []
    while at < len(data):
        milliseconds, days, north, east, count = struct.unpack_from("<IHiiB", data, at)
        at += 15
        values = {}
        for _ in range(count):
            n, value = struct.unpack_from("<Bi", data, at)
            values[ddis[n]] = value
            at += 5
        time = datetime(1980, 1, 1, tzinfo=UTC) + timedelta(days=days, milliseconds=milliseconds)
        found.append({"t": time.timestamp(), "north": north * 1e-7, "east": east * 1e-7, "values": values})
    return found


def test_the_peer_library_reads_it_strictly_and_finds_no_fault(folder):
    strict = XmlParser(ParserConfig(fail_on_unknown_properties=True, fail_on_unknown_attributes=True))
    data = strict.from_path(folder / "TASKDATA.XML", iso.Iso11783TaskData)
    assert faults(data) == []
    ((task,), (device,)) = data.tasks, data.devices
    assert task.time_logs[0].filelength == (folder / "TLG00001.bin").stat().st_size
    assert task.device_allocations[0].device_id_ref == device.id
    assert device.process_data[0].ddi == (470).to_bytes(2, "big")
    described = {part.object_id for part in device.process_data}
    assert {reference.device_object_id for reference in device.elements[0].device_object_references} == described
    assert {part.device_value_presentation_object_id for part in device.process_data} == {
        presentation.object_id for presentation in device.value_presentations
    }
    _, binaries = isoxml_from_path(folder)
    assert set(binaries) == {"TLG00001"}


def test_a_record_holds_time_place_and_the_values_of_its_window(folder, windows):
    found = records(folder)
    assert len(found) == len(windows)
    for record, window in zip(found, windows, strict=True):
        assert record["t"] == pytest.approx(window.t, abs=0.0011)
        assert record["north"] == pytest.approx(math.degrees(window.position.latitude), abs=6e-8)
        assert record["east"] == pytest.approx(math.degrees(window.position.longitude), abs=6e-8)
    first, window = found[0]["values"], windows[0]
    assert first[57344] == pytest.approx(window.bearing.value, abs=1.0)
    assert first[57345] == pytest.approx(window.bearing.std, abs=1.0)
    assert first[57346] / 1e3 == pytest.approx(math.degrees(window.posterior.parameters()["phi"].value), abs=1e-3)
    assert first[57348] == pytest.approx(window.traversability.max_draft.value, abs=1.0)
    assert first[57350] == {"unknown": 0, "no_go": 1, "caution": 2, "go": 3}[window.traversability.state]


def test_isoxml_js_reads_the_same(folder):
    read = read_by_isoxml_js(folder)
    assert read["warnings"] == []
    assert [[info["DDINumber"], info["unit"]] for info in read["valuesInfo"]][:2] == [[470, ""], [57344, "kPa"]]
    for theirs, ours in zip(read["timeLogs"], records(folder), strict=True):
        assert theirs["position"]["PositionNorth"] == pytest.approx(ours["north"], abs=1e-9)
        values = {int(key.partition("_")[0], 16): value for key, value in theirs["values"].items()}
        assert values == ours["values"]
        assert datetime.fromisoformat(theirs["time"]).timestamp() == pytest.approx(ours["t"], abs=1e-3)


def test_nothing_known_is_said_as_not_defined_and_no_number_is_made_up(folder):
    assert records(folder)[-1]["values"] == {470: 0, 57350: 0}


@pytest.mark.parametrize(("pressure", "code"), [(4.9e4, 1), (5e4, 2), (9.9e4, 2), (1e5, 3), (2e5, 4), (1e6, 4)])
def test_compaction_rises_with_the_bearing_pressure(windows, config, pressure, code):
    window = replace(windows[0], bearing=Estimate(pressure, 1e3))
    assert compaction_code(window, config.output.compaction) == code
    assert compaction_code(replace(window, status=Status.NOT_EXCITED), config.output.compaction) == 0


def test_bounds_that_do_not_rise_are_refused():
    with pytest.raises(ValueError, match="must rise"):
        Config.model_validate({"output": {"compaction": [1e5, 5e4, 2e5]}})


def test_windows_without_place_or_date_are_left_out_and_counted(windows, config, tmp_path):
    nowhere, undated = replace(windows[0], position=None), replace(windows[1], t=12.0)
    beyond = replace(windows[1], t=6.7e9)  # 2182: more days than a time log can number
    assert write_task_data(tmp_path, [nowhere, undated, windows[2], beyond], config) == 3
    assert len(records(tmp_path)) == 1


def test_each_log_is_a_task(windows, config, tmp_path):
    write_task_data(tmp_path, [*windows[:2], replace(windows[2], log="other.log")], config)
    root = ElementTree.parse(tmp_path / "TASKDATA.XML").getroot()
    assert [(task.get("A"), task.get("B")) for task in root.iter("TSK")] == [
        ("TSK1", "soilbus drive.log"),
        ("TSK2", "soilbus other.log"),
    ]
    assert (tmp_path / "TLG00002.bin").stat().st_size < (tmp_path / "TLG00001.bin").stat().st_size
